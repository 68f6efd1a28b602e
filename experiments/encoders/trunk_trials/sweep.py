from cv import *
z=np.load('stud.npz'); b=(2,4,7,10); x=blk(z['real'],b); s=blk(z['sim'],b).reshape(-1,2,x.shape[1])
C=np.load('f_tiny.npy')[KEEP][:,:192]; Cs=np.load('f_tiny_sim.npy').reshape(-1,2,192)[::2]
f=tr; mu,sd=x[f&touch].mean(0),x[f&touch].std(0)+1e-6; zz=(x-mu)/sd; ss=(s-mu)/sd; n=zz.shape[1]
def kernel(f,shr=.1):
    W,B=scatter(zz,f); d=(ss[:,0]-ss[:,1])/2; Ws=d.T@d; W=W+.5*Ws/np.trace(Ws)*n; W=W/np.trace(W)*n; e,V=np.linalg.eigh(W+shr*np.eye(n)); return (V/np.sqrt(e))@V.T
K=kernel(f); R=zz@K; S=ss@K; sc=R[f&touch].std(0); R=R/sc; S=S/sc
sdc=C[f&touch].std(0).mean(); print('std of class',sdc,'norm',np.linalg.norm(C,axis=1).mean(),'std sim class',Cs.std((0,1)).mean(),'sight sim std',S.std((0,1)).mean())
def rec50(X,centre=True):
    if centre: X=X-X.mean(0,keepdims=True)   # per side? centred over all
    X=X/np.linalg.norm(X,axis=-1,keepdims=True); r=[]
    for a in range(0,len(X)-49,50): A=X[a:a+50,0]@X[a:a+50,1].T; r+=list(A.argmax(1)==np.arange(50))
    return 100*np.mean(r)
def hard(X):
    X=X-X.mean((0,1)); X=X/np.linalg.norm(X,axis=-1,keepdims=True); A=X[:,0]@X[:,1].T; return 100*(A.argmax(1)==np.arange(len(X))).mean()
def knncv(X):
    out=[]
    for y,parts in ((yo,P_obj),(yo,P_fin),(slip.astype(int),P_slip)):
        ka=[]
        for a,b_ in parts: ka+=recs(knn(X,y,np.flatnonzero(a),b_),y,b_)
        out.append(round(100*np.mean(ka),1))
    return out
for w in (0,.045/sdc,.1,.15,.2,.3,.5,.8):
    print(f'w {w:.3f} recall of 50: {rec50(np.concatenate([Cs,w*sdc*S],-1)):.1f} of all {hard(np.concatenate([Cs,w*sdc*S],-1)):.1f} knn {knncv(np.concatenate([C,w*sdc*R],-1))}',flush=True)
