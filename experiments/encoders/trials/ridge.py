from ev import *
LAM=(1e-3,3e-3,1e-2,3e-2,1e-1,3e-1,1.0)
def ridge_path(x,y,c,fit,w,lams=LAM):
    m=x[fit].mean(0); s=np.sqrt(x[fit].var(0).mean()); z=((x-m)/s).astype(np.float64); w=w/w.sum()
    Y=np.eye(c)[y[fit]]; ym=(w[:,None]*Y).sum(0); A=z[fit]; mu=(w[:,None]*A).sum(0); A=A-mu
    K=(A*w[:,None]).T@A; e,V=np.linalg.eigh(K); R=V.T@((A*w[:,None]).T@(Y-ym)); Z=(z-mu)@V; sc=z.shape[1]
    return [Z@(R/(e[:,None]+l*e.mean()*10))+ym for l in lams]
def cvr(x,y,c,parts):
    acc=[[] for _ in LAM]
    for tr,te in parts:
        fit=np.flatnonzero(tr)
        for i,v in enumerate(ridge_path(x,y,c,fit,scores._share_weights(D.recording[fit]))):
            n=np.unique(D.recording[te])
            m=np.stack([v[te&(D.recording==g)].mean(0) for g in n]); t=np.array([y[te&(D.recording==g)][0] for g in n])
            acc[i].append(m.argmax(1)==t)
    a=[np.concatenate(q).mean() for q in acc]; return max(a),a
P_obj=[(tv&(gfold!=k),tv&(gfold==k)) for k in range(4)]
P_fin=[(tv&(gfold!=k)&(D.finger==a),tv&(gfold==k)&(D.finger==b)) for k in range(4) for a,b in (('cam0','cam2'),('cam2','cam0'))]
P_slip=[(tv&(D.fold!=k),tv&(D.fold==k)) for k in range(5)]
# test as the repo but ridge with the best lambda over CV
def fast(name,x):
    t=time.time(); o=cvr(x,yo,39,P_obj); f=cvr(x,yo,39,P_fin); s=cvr(x,D.slip.astype(int),2,P_slip)
    print(f'{name:40s} d={x.shape[1]:4d} ridge CV obj {100*o[0]:5.1f} finger {100*f[0]:5.1f} slip {100*s[0]:5.1f}  {time.time()-t:.0f}s',flush=True)
    return o[0],f[0],s[0]
