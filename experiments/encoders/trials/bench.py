from teacher import *
import teacher
from functools import partial
@partial(jax.custom_vjp,nondiff_argnums=(2,))
def dwc(x,kern,s):
    k=kern.shape[0]; B,H,W,C=x.shape; r=k//2
    x=jnp.pad(x,((0,0),(r,r),(r,r),(0,0)))
    oh,ow=(H-1)//s+1,(W-1)//s+1
    y=0
    for i in range(k):
        for j in range(k):
            y=y+x[:,i:i+(oh-1)*s+1:s,j:j+(ow-1)*s+1:s]*kern[i,j][None,None,None]
    return y
def fwd(x,kern,s): return dwc(x,kern,s),(x,kern)
def bwd(s,res,g):
    x,kern=res; k=kern.shape[0]; B,H,W,C=x.shape; r=k//2
    oh,ow=g.shape[1:3]
    xp=jnp.pad(x,((0,0),(r,r),(r,r),(0,0)))
    dk=jnp.stack([jnp.stack([ (xp[:,i:i+(oh-1)*s+1:s,j:j+(ow-1)*s+1:s]*g).sum((0,1,2)) for j in range(k)]) for i in range(k)])
    gp=lax.pad(g,0.0,((0,0,0),(0,H-((oh-1)*s+1),s-1),(0,W-((ow-1)*s+1),s-1),(0,0,0)))
    dx=dwc(gp,kern[::-1,::-1],1)
    return dx,dk
dwc.defvjp(fwd,bwd)
def convdw(x,kern,s):
    k=kern.shape[0]
    return lax.conv_general_dilated(x,kern[:,:,None],(s,s),[(k//2,k//2)]*2,dimension_numbers=('NHWC','HWIO','NHWC'),feature_group_count=x.shape[-1])
p=load()
def tm(f,*a,n=5):
    jax.block_until_ready(f(*a)); t=[]
    for _ in range(n):
        s=time.perf_counter(); jax.block_until_ready(f(*a)); t.append(time.perf_counter()-s)
    return 1e3*min(t)
B=16
sizes={1:(56,16),2:(28,24),3:(28,24),4:(14,40),5:(14,40),6:(7,80),7:(7,80),8:(7,80),9:(7,112)}
for nm,fn in (('auto',lambda x,k,s: dw(x,k,s,False)),('custom',dwc),('conv',convdw)):
    teacher.dw=lambda x,k,s,same=False: fn(x,k,s)
    for i in (1,2,3,5,6,9):
        h,c=sizes[i]; x=jnp.asarray(np.random.randn(B,h,h,c).astype(np.float32)); q=p[f'b{i:02d}']; s=BLOCKS[i][1]
        f=jax.jit(lambda q,x: teacher.block(q,x,s,False)); y=f(q,x)
        g=jax.jit(jax.grad(lambda q,x: ((teacher.block(q,x,s,False)-y)**2).mean()))
        print(nm,i,'fwd %.1f grad %.1f ms'%(tm(f,q,x),tm(g,q,x)),flush=True)
