import numpy as np, time
Z=np.load('rt2_meta.npz',allow_pickle=True); KEEP=np.arange(4800)%3==1
rec,fin,split,fold,obj,slip,group,score,unit=[Z[k][KEEP] for k in('recording','finger','split','fold','object','slip','group','score','unit')]
names=np.unique(obj); yo=np.searchsorted(names,obj); tv=split!='test'; tr=split=='train'; GR=np.unique(group,return_inverse=True)[1]
rng=np.random.default_rng(0); gf={}
for o in names:
    gs=np.unique(group[(obj==o)&tv])
    if len(gs)>1:
        for i,g in enumerate(rng.permutation(gs)): gf[g]=i%4
gfold=np.array([gf.get(g,-1) for g in group])
LAM=(1e-3,3e-3,1e-2,3e-2,1e-1,3e-1,1.0)
P_obj=[(tv&(gfold!=k),tv&(gfold==k)) for k in range(4)]
P_fin=[(tv&(gfold!=k)&(fin==a),tv&(gfold==k)&(fin==b)) for k in range(4) for a,b in (('cam0','cam2'),('cam2','cam0'))]
P_slip=[(tv&(fold!=k),tv&(fold==k)) for k in range(5)]
def ridge(x,y,c,fit,w):
    m=x[fit].mean(0); s=np.sqrt(x[fit].var(0).mean()); z=((x-m)/s).astype(np.float32); w=(w/w.sum()).astype(np.float32)
    Y=np.eye(c,dtype=np.float32)[y[fit]]; ym=(w[:,None]*Y).sum(0); A=z[fit]; mu=(w[:,None]*A).sum(0); A=A-mu
    K=(A*w[:,None]).T@A; e,V=np.linalg.eigh(K); R=V.T@((A*w[:,None]).T@(Y-ym)); Q=(z-mu)@V
    return [Q@(R/(e[:,None]+l*e.mean()*10))+ym for l in LAM]
def wts(g): _,i,c=np.unique(g,return_inverse=True,return_counts=True); return 1/c[i]
def recs(v,y,te): 
    n=np.unique(rec[te]); return [(v[te&(rec==q)].mean(0).argmax()==y[te&(rec==q)][0]) for q in n]
def knn(x,y,fit,te,k=10):
    z=x-x[fit].mean(0); z=z/np.linalg.norm(z,axis=1,keepdims=True); S=z[te]@z[fit].T; n=np.argsort(-S,1)[:,:k]; v=np.zeros((len(x),y.max()+1))
    vv=np.zeros((te.sum(),y.max()+1)); np.add.at(vv,(np.arange(te.sum())[:,None],y[fit][n]),np.exp(np.take_along_axis(S,n,1)/.1)); v[te]=vv; return v
def cv(name,make,touched=True):
    "make(fit mask) -> features; the discriminants see only groups of the fit"
    out=[]; kn=[]
    for y,c,parts in ((yo,len(names),P_obj),(yo,len(names),P_fin),(slip.astype(int),2,P_slip)):
        acc=[[] for _ in LAM]; ka=[]; cache={}
        for a,b in parts:
            g=tv&~np.isin(GR,np.unique(GR[b])); key=g.tobytes()
            if key not in cache: cache[key]=make(g)
            x=cache[key]; fit=np.flatnonzero(a)
            for i,v in enumerate(ridge(x,y,c,fit,wts(rec[fit]))): acc[i]+=recs(v,y,b)
            ka+=recs(knn(x,y,fit,b),y,b)
        out.append(100*max(np.mean(q) for q in acc)); kn.append(100*np.mean(ka))
    print(f'{name:44s} d {x.shape[1]:4d} obj {out[0]:5.1f} finger {out[1]:5.1f} slip {out[2]:5.1f} | knn {kn[0]:5.1f} {kn[1]:5.1f} {kn[2]:5.1f}',flush=True)
st=lambda x,f: (x-x[f].mean(0))/(x[f].std(0)+1e-6)
touch=score>5
CH=np.cumsum([0,32,16,24,24,40,40,80,80,80,112,112,112,192,192,192,192,320])
blk=lambda m,b: np.concatenate([m[:,CH[i+1]:CH[i+2]] for i in b],1)
def scatter(z,f):
    n=z.shape[1]; B=np.zeros((n,n)); W=np.zeros((n,n)); f=f&touch
    for g in np.unique(GR[f]):
        ms=[z[f&(GR==g)&(fin==b)].mean(0) for b in ('cam0','cam2') if (f&(GR==g)&(fin==b)).sum()>0]
        if len(ms)==2:
            d=(ms[0]-ms[1])/2; W+=np.outer(d,d)*2; q=(ms[0]+ms[1])/2; B+=np.outer(q,q)*2
    return W/np.trace(W)*n,B/np.trace(B)*n
def lda(x,sim,f,k,shr=.1,a=.5):
    "sim (m,2,d): pairs"
    mu,sd=x[f&touch].mean(0),x[f&touch].std(0)+1e-6; z=(x-mu)/sd; s=(sim-sim.mean((0,1)))/sd; n=z.shape[1]
    W,B=scatter(z,f); 
    if a:
        d=(s[:,0]-s[:,1])/2; Ws=d.T@d; q=s.mean(1); Bs=q.T@q; W=W+a*Ws/np.trace(Ws)*n; B=B+a*Bs/np.trace(Bs)*n
    W=W/np.trace(W)*n+shr*np.eye(n); e,V=np.linalg.eigh(W); R=V/np.sqrt(e); e2,U=np.linalg.eigh(R.T@B@R); return st(z@(R@U[:,::-1][:,:k]),f)
def white(x,sim,f,k,shr=.03,a=.5):
    mu,sd=x[f&touch].mean(0),x[f&touch].std(0)+1e-6; z=(x-mu)/sd; s=((sim-sim.mean((0,1)))/sd).reshape(-1,x.shape[1])
    C=np.cov(z[f&touch].T); Cs=np.cov(s.T); C=C/np.trace(C)+a*Cs/np.trace(Cs); e,V=np.linalg.eigh(C); o=np.argsort(e)[::-1][:k]; return st(z@V[:,o]/np.sqrt(e[o]+shr*e.mean()),f)
cat=lambda *a: np.concatenate(a,1)
def within(x,sim,f,a=.5):
    mu,sd=x[f&touch].mean(0),x[f&touch].std(0)+1e-6; z=(x-mu)/sd; s=(sim-sim.mean((0,1)))/sd; n=z.shape[1]
    W,B=scatter(z,f)
    if a: d=(s[:,0]-s[:,1])/2; Ws=d.T@d; W=W+a*Ws/np.trace(Ws)*n
    return z,W/np.trace(W)*n
def wccn(x,sim,f,shr,a=.5):
    z,W=within(x,sim,f,a); e,V=np.linalg.eigh(W+shr*np.eye(len(W))); return st(z@(V/np.sqrt(e))@V.T,f)
def nap(x,sim,f,r,a=.5):
    z,W=within(x,sim,f,a); e,V=np.linalg.eigh(W); N=V[:,::-1][:,:r]; return st(z-z@N@N.T,f)
