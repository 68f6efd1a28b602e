import jax,jax.numpy as jnp,numpy as np,time
from jax import lax
def tm(f,*a,n=5):
    jax.block_until_ready(f(*a)); t=[]
    for _ in range(n):
        s=time.perf_counter(); jax.block_until_ready(f(*a)); t.append(time.perf_counter()-s)
    return 1e3*min(t)
def sl(xp,i,j,oh,ow,s): return xp[:,i:i+(oh-1)*s+1:s,j:j+(ow-1)*s+1:s]
def a(xp,g,k,s):
    oh,ow=g.shape[1:3]; return jnp.stack([(sl(xp,i,j,oh,ow,s)*g).sum((0,1,2)) for i in range(k) for j in range(k)])
def b(xp,g,k,s):
    oh,ow=g.shape[1:3]; C=g.shape[-1]; one=jnp.ones((1,g.size//C)); return jnp.stack([(one@(sl(xp,i,j,oh,ow,s)*g).reshape(-1,C))[0] for i in range(k) for j in range(k)])
def c(xp,g,k,s):  # scan over rows of images accumulate k*k*C
    oh,ow=g.shape[1:3]; C=g.shape[-1]
    # scan over (B) images: acc over (oh,ow) by fori, elementwise carry (ow? ) 
    def f(acc,xg):
        x,gg=xg  # (H,W,C),(oh,ow,C)
        return tuple(acc[n]+ (x[n//k:n//k+(oh-1)*s+1:s,n%k:n%k+(ow-1)*s+1:s]*gg).sum(0) for n in range(k*k)),None
    acc,_=lax.scan(f,tuple(jnp.zeros((ow,C)) for _ in range(k*k)),(xp,g)); return jnp.stack([t.sum(0) for t in acc])
def d(xp,g,k,s): # sum over batch first elementwise? accumulate elementwise over batch with python loop
    oh,ow=g.shape[1:3]; C=g.shape[-1]; out=[]
    for n in range(k*k):
        acc=0
        for m in range(g.shape[0]): acc=acc+xp[m,n//k:n//k+(oh-1)*s+1:s,n%k:n%k+(ow-1)*s+1:s]*g[m]
        acc=acc.reshape(oh,-1)
        t=0
        for r in range(oh): t=t+acc[r]
        t=t.reshape(ow,C); u=0
        for r in range(ow): u=u+t[r]
        out.append(u)
    return jnp.stack(out)
def e(xp,g,k,s): # channels to front then dot batch over C
    oh,ow=g.shape[1:3]; C=g.shape[-1]
    gt=g.reshape(-1,C).T[:,None]  # C,1,R
    xs=jnp.stack([sl(xp,i,j,oh,ow,s).reshape(-1,C).T for i in range(k) for j in range(k)],-1) # C,R,kk
    return jnp.einsum('cor,crk->kc',gt,xs)
for B,H,C,k,s in ((16,28,144,3,1),(16,7,480,3,1),(16,7,672,5,1)):
    r=k//2; x=jnp.asarray(np.random.randn(B,H+2*r,H+2*r,C).astype('f')); g=jnp.asarray(np.random.randn(B,H,H,C).astype('f'))
    ref=None
    for f in (a,b,c,d):
        h=jax.jit(lambda x,g: f(x,g,k,s)); o=h(x,g); ref=o if ref is None else ref
        print((B,H,C,k),f.__name__,'%.1f ms'%tm(h,x,g),float(jnp.abs(o-ref).max()),flush=True)
