from e8_defs import *
M24=std(cat(mn(2),mn(4))); T=std(tiny)
sc=D_score=d['score']; U=d['unit']
def lda2(x,fit,k,shr=.1,free=1.0,unit=0.0,pair=1.0):
    mu=x[fit&touch].mean(0); z=x-mu; n=x.shape[1]; B=np.zeros((n,n)); W=np.zeros((n,n)); c=0
    f=fit&touch
    for a in np.unique(GR[f]):
        ms=[z[f&(GR==a)&(D.finger==b)].mean(0) for b in ('cam0','cam2') if (f&(GR==a)&(D.finger==b)).sum()>1]
        if len(ms)==2:
            dl=(ms[0]-ms[1])/2; W+=np.outer(dl,dl)*2; mm=(ms[0]+ms[1])/2; B+=np.outer(mm,mm)*2; c+=1
    W/=c;B/=c; W=pair*W/np.trace(W)*n
    if free:
        q=z[fit&(sc<4)]; q=q-q.mean(0); N=q.T@q/len(q); W=W+free*N/np.trace(N)*n
    if unit:
        ms=np.stack([z[fit&(U==u)].mean(0) for u in np.unique(U[fit])]); ms-=ms.mean(0); N=ms.T@ms; W=W+unit*N/np.trace(N)*n
    W=W/np.trace(W)*n+shr*np.eye(n)
    e,V=np.linalg.eigh(W); R=V/np.sqrt(e); e2,Uu=np.linalg.eigh(R.T@B@R); return (x-mu)@(R@Uu[:,::-1][:,:k])
if __name__=='__main__':
    X=cat(S,M24)
    for kw in (dict(free=0),dict(free=1),dict(free=1,unit=1),dict(free=0,unit=1),dict(free=1,unit=1,shr=.03)):
        go(f'S+M24 160 {kw}',lambda f: st(lda2(X,f,160,**kw),f))
    for kw in (dict(free=0),dict(free=1,unit=1)):
        go(f'S 96 {kw}',lambda f: st(lda2(S,f,96,**kw),f))
    go('T,S,M24 192 free1',lambda f: st(lda2(cat(T,X),f,192),f))
