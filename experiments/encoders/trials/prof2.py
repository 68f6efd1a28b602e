import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
import numpy as np, jax, jax.numpy as jnp, time
from anytouch_jax.nn import sight
from anytouch_jax.nn.fields import windows
k=np.random.rand(27,32).astype('f'); b=np.zeros(32,'f'); x=jnp.asarray(np.random.rand(1,112,112,3).astype('f'))
def a(k,b,x): return sight.stem({'kernel':k,'bias':b},x).mean((1,2))
def c(k,b,x):
    w=windows(x,3,2); return sight.relu6((w.reshape(-1,27)@k).reshape(*w.shape[:3],32)+b).mean((1,2))
def d(k,b,x): # pixel pairs: pad to 114x114 -> reshape (57,2*?)  space-to-depth: 2x2 stride: window 3x3 within 2x2 blocks of s2d (12 ch): 4 neighbours
    p=jnp.pad(x,((0,0),(1,1),(1,1),(0,0)))  # 114
    s=p.reshape(1,57,2,57,6).transpose(0,1,3,2,4).reshape(1,57,57,12)
    w=jnp.concatenate([s[:,i:i+56,j:j+56] for i in (0,1) for j in (0,1)],-1)
    K=np.zeros((2,2,2,2,3,32),'f')
    return sight.relu6((w.reshape(-1,48)@jnp.asarray(kk)).reshape(1,56,56,32)+b).mean((1,2))
K=np.zeros((2,2,2,2,3,32),'f'); k4=k.reshape(3,3,3,32)
for bi in range(2):
  for bj in range(2):
    for i in range(2):
      for j in range(2):
        r,cc=2*bi+i,2*bj+j
        if r<3 and cc<3: K[bi,bj,i,j]=k4[r,cc]
kk=K.reshape(48,32)
def e(k,b,x): # 27 terms broadcast
    p=jnp.pad(x,((0,0),(1,1),(1,1),(0,0))); y=0
    for i in range(3):
        for j in range(3):
            for ch in range(3): y=y+p[:,i:i+111:2,j:j+111:2,ch:ch+1]*k4[i,j,ch]
    return sight.relu6(y+b).mean((1,2))
fs=[jax.jit(f) for f in (a,c,d,e)]; ref=fs[0](k,b,x)
for f in fs: print(float(jnp.abs(f(k,b,x)-ref).max()))
t=[[] for _ in fs]
for _ in range(200):
    for i,f in enumerate(fs):
        s=time.perf_counter(); f(k,b,x).block_until_ready(); t[i].append(time.perf_counter()-s)
print([round(1e3*np.percentile(v,10),3) for v in t])
