from ridge import *
m=np.load('runs/d/f112.npz')['mean']; S=std(blk(m,0,1,2,4,7))
touch=d['score']>5; GR=np.unique(G,return_inverse=True)[1]
def lda(x,fit,k,shr=.1):
    f=np.flatnonzero(fit&touch); mu=x[f].mean(0); z=x[f]-mu; g=GR[f]; fi=(D.finger[f]=='cam2').astype(int)
    n=x.shape[1]; B=np.zeros((n,n)); W=np.zeros((n,n)); c=0
    cell={}
    for a in np.unique(g):
        ms=[z[(g==a)&(fi==b)].mean(0) for b in (0,1) if ((g==a)&(fi==b)).sum()>1]
        if len(ms)==2:
            dlt=(ms[0]-ms[1])/2; W+=np.outer(dlt,dlt)*2; mm=(ms[0]+ms[1])/2; B+=np.outer(mm,mm)*2; c+=1
    W/=c;B/=c; W=W+shr*np.trace(W)/n*np.eye(n)
    e,V=np.linalg.eigh(W); R=V/np.sqrt(e); e2,U=np.linalg.eigh(R.T@B@R); P=R@U[:,::-1][:,:k]
    return (x-mu)@P
class F: pass
def cvp(name,make):
    r=[]
    for y,c,parts in ((yo,39,P_obj),(yo,39,P_fin),(D.slip.astype(int),2,P_slip)):
        acc=[[] for _ in LAM]
        cache={}
        for tr,te in parts:
            fitg=tv&~np.isin(GR,np.unique(GR[te]))
            key=fitg.tobytes()
            if key not in cache: cache={key:make(fitg)}
            x=cache[key]; fit=np.flatnonzero(tr)
            for i,v in enumerate(ridge_path(x,y,c,fit,scores._share_weights(D.recording[fit]))):
                n=np.unique(D.recording[te]); mm=np.stack([v[te&(D.recording==q)].mean(0) for q in n]); t=np.array([y[te&(D.recording==q)][0] for q in n]); acc[i].append(mm.argmax(1)==t)
        r.append(max(np.concatenate(q).mean() for q in acc))
    print(f'{name:40s} obj {100*r[0]:5.1f} finger {100*r[1]:5.1f} slip {100*r[2]:5.1f}',flush=True)
if __name__=='__main__':
    st=lambda x,f: (x-x[f].mean(0))/(x[f].std(0)+1e-6)
    T=std(tiny)
    cvp('tiny',lambda f: T); cvp('tiny+S',lambda f: np.concatenate([T,S],1))
    for k in (24,48,96):
        cvp(f'S lda {k}',lambda f: st(lda(S,f,k),f))
        cvp(f'tiny+S lda {k}',lambda f: np.concatenate([T,st(lda(S,f,k),f)],1))
    cvp('lda(tiny+S) 128',lambda f: st(lda(np.concatenate([T,S],1),f,128),f))
