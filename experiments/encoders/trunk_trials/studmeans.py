import sys; from long3 import *
S=load(sys.argv[1]) if sys.argv[1]=='state.pt' else None
if S is None:
    S=Net(10,True); S.stem.plain=False
    for b in S.blocks: b.narrow.plain=False
    S=fold(S.eval()); S.load_state_dict(torch.load(sys.argv[1]))
params={}
layers={'stem':S.stem}
for i,b in enumerate(S.blocks):
    for n in ('wide','depth','narrow'):
        if getattr(b,n) is not None: layers[f'block{i}/{n}']=getattr(b,n)
for n,l in layers.items():
    k=l.c.weight.data; params[n+'/kernel']=k.permute(2,3,1,0).reshape(-1,k.shape[0]).numpy(); params[n+'/bias']=l.c.bias.data.numpy()
np.savez('run/trunk.npz',**params)
r=np.load('rt2.npz'); x=r['sub'][np.arange(4800)%3==1]; q=np.load('sim_sub.npy').reshape(-1,2,112,112,3)[::2].reshape(-1,112,112,3)
def means(u):
    with torch.no_grad(): return np.concatenate([np.concatenate([o.mean((2,3)).numpy() for o in S(chl(u[i:i+16]))],1) for i in range(0,len(u),16)])
np.savez('stud.npz',real=means(x),sim=means(q))

T=teacher(10); sets=held(); S.eval()
def centred(S,T,sets):
    with torch.no_grad():
        for n,x in sets.items():
            x=x[:84]; a,b=[],[]
            for i in range(0,len(x),16):
                q=chl(x[i:i+16]); a.append([o.mean((2,3)) for o in S(q)]); b.append([o.mean((2,3)) for o in T(q)])
            r=[]
            for k in range(len(a[0])):
                s,t=torch.cat([v[k] for v in a]),torch.cat([v[k] for v in b]); s=s-s.mean(0); t=t-t.mean(0); v=t.var(0); r.append(100*(1-(((s-t)**2).mean(0)/(v+.05*v.mean())).mean()).item())
            print(f'   {n:14s}',' '.join(f'{v:5.0f}' for v in r),flush=True)
centred(S,T,sets)
