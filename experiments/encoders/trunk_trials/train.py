import sys, time, os, json
from net import *
from data import Stream, held
import torch.nn.functional as F
def chl(u): return levels(torch.from_numpy(u)).permute(0,3,1,2).contiguous(memory_format=torch.channels_last)
def R2(S,T,sets,folded=False):
    S.eval(); res={}
    with torch.no_grad():
        for n,x in sets.items():
            a,b=[],[]
            for i in range(0,len(x),16):
                q=chl(x[i:i+16]); a.append([o.mean((2,3)) for o in S(q)]); b.append([o.mean((2,3)) for o in T(q)])
            r=[]
            for k in range(len(a[0])):
                s,t=torch.cat([v[k] for v in a]),torch.cat([v[k] for v in b]); v=t.var(0); r.append(100*(1-(((s-t)**2).mean(0)/(v+.05*v.mean())).mean()).item())
            res[n]=r
    S.train(); return res
def show(res): 
    for n,r in res.items(): print(f'   {n:14s}',' '.join(f'{v:5.0f}' for v in r),flush=True)
def muon(p,g,buf,lr,mom=.95):
    buf.mul_(mom).add_(g); g=g.add(buf,alpha=mom); G=g.reshape(len(g),-1); X=G/(G.norm()+1e-7); tr=X.shape[0]>X.shape[1]
    if tr: X=X.T
    for _ in range(5):
        A=X@X.T; X=3.4445*X+(-4.7750*A+2.0315*A@A)@X
    if tr: X=X.T
    p.add_(X.reshape(p.shape),alpha=-lr*max(1,G.shape[0]/G.shape[1])**.5)
class Opt:
    def __init__(self,net,lr,mlr,kind,b2=.99):
        mats=[p for p in net.parameters() if p.requires_grad and p.ndim==4 and p.shape[1]>1 and p.shape[0]>1] if kind=='muon' else []
        ids={id(p) for p in mats}; self.mats=[(p,torch.zeros_like(p)) for p in mats]; self.mlr=mlr
        self.adam=torch.optim.Adam([p for p in net.parameters() if p.requires_grad and id(p) not in ids],lr=lr,betas=(.9,b2)); self.lr=lr
    @torch.no_grad()
    def step(self,f):
        for g in self.adam.param_groups: g['lr']=self.lr*f
        self.adam.step(); self.adam.zero_grad(set_to_none=True)
        for p,b in self.mats: muon(p,p.grad,b,self.mlr*f); p.grad=None
def stats(T,st,s,n=192):
    M={True:[],False:[]}; V=[]
    for _ in range(n//48):
        u,d=st.batch(48,s); o=T(chl(u)); V.append([torch.stack([(y**2).mean((0,2,3)),y.mean((0,2,3))]) for y in o])
        for k in (True,False): M[k].append([y.mean((2,3))[torch.from_numpy(d)==k] for y in o])
    L=len(V[0]); sd=[]
    for i in range(L):
        q=torch.stack([v[i] for v in V]).mean(0); v=(q[0]-q[1]**2).clamp_min(0).sqrt(); sd.append(torch.maximum(v,.2*v.median()))
    ms={k:[(lambda v: torch.maximum(v,.3*v.median()))(torch.cat([m[i] for m in M[k]]).std(0)) for i in range(L)] for k in M}
    return sd,ms
def loss_of(s,t,sd,ms,dom,i,wm):
    e=(s-t)/sd[i][:,None,None]; flat=(t.var((2,3))/sd[i]**2).mean(1)
    maps=((e**2).mean((1,2,3))/(flat+.1))
    off=(s.mean((2,3))-t.mean((2,3)))/torch.where(dom[:,None],ms[True][i],ms[False][i])
    mean=(5*torch.log1p(off**2/5)).mean(1)
    return maps.mean(),mean.mean()
def run(S,T,st,s,batch,seconds,lr,mlr,kind,mode,wm=.3,sets=None,every=120,out=None,anneal=False,warm=20,floor=.05,wts=None):
    sd,ms=stats(T,st,s); op=Opt(S,lr,mlr,kind); t0=time.time(); c0=time.process_time(); k=0; ev=0; avg=None
    S.train() if mode!='fold' else S.eval()
    while True:
        p=(time.process_time()-c0)/seconds if seconds>0 else (time.time()-t0)/-seconds
        if p>=1: break
        u,d=st.batch(batch,s); x=chl(u); dom=torch.from_numpy(d)
        with torch.no_grad(), torch.autocast('cpu',torch.bfloat16): t=[y.float() for y in T(x)]
        if mode=='forced':
            o=[S.stem(x)]+[b(t[i]) for i,b in enumerate(S.blocks)]
        else: o=S(x)
        ls=[loss_of(a,b,sd,ms,dom,i,wm) for i,(a,b) in enumerate(zip(o,t))]
        total=sum((m+wm*q) for m,q in ls)
        total.backward()
        f=min(1,(k+1)/warm)*((floor+(1-floor)*.5*(1+np.cos(np.pi*p))) if anneal else 1)
        op.step(f); k+=1
        r=np.array([[m.item(),q.item()] for m,q in ls]); avg=r if avg is None else avg+.03*(r-avg)
        if time.process_time()-c0>ev:
            ev+=every; print(f'{mode} {s}px {time.time()-t0:.0f}s cpu {time.process_time()-c0:.0f} step {k} f {f:.2f} maps',' '.join(f'{v:.3f}' for v in avg[:,0]),'| means',' '.join(f'{v:.2f}' for v in avg[:,1]),flush=True)
            if out: torch.save(S.state_dict(),out+'.part'); os.replace(out+'.part',out)
    print('end step',k,f'cpu {time.process_time()-c0:.0f}','maps',' '.join(f'{v:.3f}' for v in avg[:,0]),'| means',' '.join(f'{v:.2f}' for v in avg[:,1]))
    if sets is not None: show(R2(S,T,sets)) 
    if out: torch.save(S.state_dict(),out)

def scaled_start(S,T,st):
    "outputs begin with the mean and the spread of what the teacher adds"
    tot=None
    with torch.no_grad():
        if isinstance(S.stem.c,White): S.stem.c.set(chl(st.batch(64,64)[0]))
        for _ in range(4):
            o=T(chl(st.batch(48,64)[0])); r=[]
            for i,y in enumerate(o):
                if i and S.blocks[i-1].add: y=y-o[i-1]
                r.append(torch.stack([y.mean((0,2,3)),(y**2).mean((0,2,3))]))
            tot=r if tot is None else [a+b for a,b in zip(tot,r)]
    for i,v in enumerate(tot):
        m,q=v/4; sd=(q-m*m).clamp_min(0).sqrt(); sd=torch.maximum(sd,.2*sd.median()); c=S.stem if i==0 else S.blocks[i-1].narrow
        c.plain=False; c.scale.copy_(sd); c.shift.copy_(m)
        if i: c.b.weight.data.fill_(.5)
