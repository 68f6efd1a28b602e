import sys,os; sys.path[:0]=['/work/distil/src','/work/distil','/work/distil/runs/d']
import numpy as np, time
from experiments.real import scores, recordings
from types import SimpleNamespace as NS
d=dict(np.load('/work/distil/runs/d/rt2.npz',allow_pickle=True))
D=NS(recording=d['recording'],finger=d['finger'],split=d['split'],fold=d['fold'],object=d['object'],slip=d['slip'],names=np.unique(d['object']))
tv=d['split']!='test'
# folds of grasp groups within objects that have several, on train+val
rng=np.random.default_rng(0); G=d['group']; gf={}
for o in D.names:
    gs=np.unique(G[(d['object']==o)&tv]); 
    if len(gs)>1:
        for i,g in enumerate(rng.permutation(gs)): gf[g]=i%4
gfold=np.array([gf.get(g,-1) for g in G])
pen=(1.0,.1,.01,.001)
def path(x,y,c,fit,w):
    old=scores.PENALTIES; scores.PENALTIES=pen
    try: return scores.linear_scores(x,y,c,fit,w)
    finally: scores.PENALTIES=old
def rec(vals,y,part,groups):
    n=np.unique(groups[part]); m=np.stack([vals[part&(groups==g)].mean(0) for g in n]); t=np.array([y[part&(groups==g)][0] for g in n])
    return m.argmax(1)==t, -np.log(np.maximum(m[np.arange(len(n)),t],1e-9))
def cv(x,y,classes,parts):
    R=[[] for _ in pen];L=[[] for _ in pen]
    for tr,te in parts:
        fit=np.flatnonzero(tr)
        for i,(p,v) in enumerate(path(x,y,classes,fit,scores._share_weights(D.recording[fit]))):
            r,l=rec(v,y,te,D.recording); R[i].append(r);L[i].append(l)
    ls=[np.concatenate(l).mean() for l in L]; b=int(np.argmin(ls)); return np.concatenate(R[b]).mean(),ls[b]
yo=np.searchsorted(D.names,D.object)
def std(x):
    f=x[d['split']=='train']; return ((x-f.mean(0))/(f.std(0)+1e-6)).astype(np.float32)
def valcv(x):
    o=cv(x,yo,39,[(tv&(gfold!=k),tv&(gfold==k)) for k in range(4)])
    f=cv(x,yo,39,[(tv&(gfold!=k)&(D.finger==a),tv&(gfold==k)&(D.finger==b)) for k in range(2) for a,b in (('cam0','cam2'),('cam2','cam0'))])
    s=cv(x,D.slip.astype(int),2,[(tv&(D.fold!=k),tv&(D.fold==k)) for k in range(5)])
    return o,f,s
def test(x):
    return [t(x,D).share for t in (scores.object_score,scores.other_finger_score,scores.slip_score)]
def show(name,x,tst=True):
    t=time.time(); o,f,s=valcv(x); a=f'{name:34s} d={x.shape[1]:4d} CV obj {o[0]*100:5.1f} ({o[1]:.3f}) finger {f[0]*100:5.1f} ({f[1]:.3f}) slip {s[0]*100:5.1f} ({s[1]:.3f})'
    if tst: T=test(x); a+=' | TEST obj %.1f finger %.1f slip %.1f'%tuple(100*v for v in T)
    print(a,'%.0fs'%(time.time()-t),flush=True)
tiny=np.load('/work/distil/runs/d/f_tiny.npy')
CH=np.cumsum([0,32,16,24,24,40,40,80,80,80,112,112,112,192,192,192,192,320])
def blk(m,*bs): return np.concatenate([m[:,CH[b+1]:CH[b+2]] for b in bs],1)   # b=-1 is the stem
