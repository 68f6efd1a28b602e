from cv import *
T2=np.load('f_tiny.npy')[KEEP]; z=np.load('stud.npz'); m,q=z['real'],z['sim']
T=st(T2[:,:192],tr); TT=st(T2,tr)
for b in ((2,4,7,10),):
    x=blk(m,b); s=blk(q,b).reshape(-1,2,x.shape[1])
    cv('T',lambda f: T)
    for sh in (.03,.1,.3): cv(f'T+wccn {sh} {b}',lambda f: cat(T,wccn(x,s,f,sh)))
    cv(f'T+lda96 {b}',lambda f: cat(T,lda(x,s,f,96)))
    cv(f'T+raw {b}',lambda f: cat(T,st(x,f)))
    cv('both poolings',lambda f: TT)
    cv(f'both+wccn .1 {b}',lambda f: cat(TT,wccn(x,s,f,.1)))
