from cv import *
T2=np.load('f_tiny.npy')[KEEP]; m=np.load('f112.npz')['mean'][KEEP]; q=np.load('teacher_sim.npy')
T=st(T2[:,:192],tr)
B4=(0,1,2,4,7); B5=(0,1,2,4,7,10)
for b in (B4,B5,(2,4,7,10)):
    x=blk(m,b); s=blk(q,b).reshape(-1,2,x.shape[1])
    for sh in (.03,.1,.3,1.,3.): cv(f'T+wccn {sh} {b}',lambda f: cat(T,wccn(x,s,f,sh)))
    for r in (4,12,24): cv(f'T+nap {r} {b}',lambda f: cat(T,nap(x,s,f,r)))
    for k in (96,160): cv(f'T+lda{k} {b}',lambda f: cat(T,lda(x,s,f,k)))
