from e8_defs import *
T=std(tiny); m=np.load('runs/d/f112.npz')['mean']; raw=blk(m,0,1,2,4,7); tr=D.split=='train'
q=np.load('runs/d/f_sim.npy'); q=np.concatenate([q[:,c[b]:c[b+1]] for b in (0,1,2,4,7)],1)
mu,sg=raw[tr].mean(0),raw[tr].std(0)+1e-6
qs=((q-mu)/sg).reshape(-1,2,q.shape[1])
# robust: scale of sim
print('sim std over real std per block', [round(float(v),2) for v in (q.std(0)/sg)[[0,20,50,90,150]]])
def lda3(x,fit,k,shr=.1,a=1.0,pair=1.0,between=1.0):
    z0=x[fit&touch].mean(0); z=x-z0; n=x.shape[1]; B=np.zeros((n,n)); W=np.zeros((n,n)); cc=0
    f=fit&touch
    for g_ in np.unique(GR[f]):
        ms=[z[f&(GR==g_)&(D.finger==b)].mean(0) for b in ('cam0','cam2') if (f&(GR==g_)&(D.finger==b)).sum()>1]
        if len(ms)==2:
            dl=(ms[0]-ms[1])/2; W+=np.outer(dl,dl)*2; mm=(ms[0]+ms[1])/2; B+=np.outer(mm,mm)*2; cc+=1
    W=pair*W/np.trace(W)*n; B=B/np.trace(B)*n
    dl=(qs[:,0]-qs[:,1])/2; Ws=dl.T@dl; mm=(qs[:,0]+qs[:,1])/2; mm=mm-mm.mean(0); Bs=mm.T@mm
    W=W+a*Ws/np.trace(Ws)*n; B=B+between*a*Bs/np.trace(Bs)*n
    W=W/np.trace(W)*n+shr*np.eye(n)
    e,V=np.linalg.eigh(W); R=V/np.sqrt(e); e2,Uu=np.linalg.eigh(R.T@B@R); return (x-z0)@(R@Uu[:,::-1][:,:k])
if __name__=='__main__':
    for k in (96,128):
        for kw in (dict(a=0),dict(a=.5),dict(a=1),dict(a=1,between=0),dict(pair=0,a=1)):
            go(f'S {k} {kw}',lambda f: st(lda3(S,f,k,**kw),f))
    f=tr
    for n_,x in (('T+S lda3 a=.5 96',cat(T,st(lda3(S,f,96,a=.5),f))),('T+S lda3 a=.5 128',cat(T,st(lda3(S,f,128,a=.5),f)))):
        print(n_,'TEST logistic obj finger slip',[round(100*v,1) for v in test(x)],flush=True)
