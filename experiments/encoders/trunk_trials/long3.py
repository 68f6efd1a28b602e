from train import *
import datetime
class Rel:
    "Adam, each array at a rate in proportion to its size"
    def __init__(self,net,rate):
        self.g=[dict(params=[p],base=rate*max(float(p.detach().pow(2).mean().sqrt()),1e-3)) for p in net.parameters()]
        self.adam=torch.optim.Adam([dict(params=g['params'],lr=g['base']) for g in self.g],betas=(.9,.99)); self.lr=rate
    def step(self,f):
        for g,h in zip(self.adam.param_groups,self.g): g['lr']=h['base']*f
        self.adam.step(); self.adam.zero_grad(set_to_none=True)
def load(path,last=10):
    S=Net(last,True); S.stem.plain=False
    for b in S.blocks: b.narrow.plain=False
    S.load_state_dict(torch.load(path)); S=fold(S.eval())
    for p in S.parameters(): p.requires_grad_(True)
    return S
def left(h,m): return (datetime.datetime.now().replace(hour=h,minute=m,second=0)-datetime.datetime.now()).total_seconds()
def run3(S,T,st,s,batch,end,rate,floor,out,wm=.3,every=15,n=96):
    sd,ms=stats(T,st,s,n); op=Rel(S,rate); c0=time.process_time(); total=left(*end); k=0; ev=0; avg=None
    while (l:=left(*end))>0:
        p=1-l/total; u,d=st.batch(batch,s); x=chl(u); dom=torch.from_numpy(d)
        with torch.no_grad(), torch.autocast('cpu',torch.bfloat16): t=[y.float() for y in T(x)]
        o=S(x); ls=[loss_of(a,b,sd,ms,dom,i,wm) for i,(a,b) in enumerate(zip(o,t))]
        sum((m+wm*q) for m,q in ls).backward()
        op.step(min(1,(k+1)/10)*(floor+(1-floor)*.5*(1+np.cos(np.pi*p)))); k+=1
        r=np.array([[m.item(),q.item()] for m,q in ls]); avg=r if avg is None else avg+.05*(r-avg)
        if time.process_time()-c0>ev:
            ev+=every; print(f'{s}px left {l:.0f} cpu {time.process_time()-c0:.0f} step {k} maps',' '.join(f'{v:.3f}' for v in avg[:,0]),'| means',' '.join(f'{v:.2f}' for v in avg[:,1]),flush=True)
            torch.save(S.state_dict(),out+'.part'); os.replace(out+'.part',out)
    torch.save(S.state_dict(),out); print('end',k,f'cpu {time.process_time()-c0:.0f}',flush=True)
if __name__=='__main__':
    torch.manual_seed(2); T=teacher(10); S=load(sys.argv[1]); st=Stream(2)
    run3(S,T,st,64,16,(15,12),.015,.25,'F64.pt')
    st.share=.6; run3(S,T,st,112,8,(15,25),.005,.03,'F112.pt')
