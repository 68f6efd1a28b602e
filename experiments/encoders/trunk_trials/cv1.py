from cv import *
T2=np.load('f_tiny.npy')[KEEP]; m=np.load('f112.npz')['mean'][KEEP]; q=np.load('teacher_sim.npy')
T=st(T2[:,:192],tr)
B4=(0,1,2,4,7); B5=(0,1,2,4,7,10)
cv('T',lambda f: T)
for b in (B4,B5):
    x=blk(m,b); s=blk(q,b).reshape(-1,2,x.shape[1])
    cv(f'raw {b}',lambda f: st(x,f)); cv(f'T+raw {b}',lambda f: cat(T,st(x,f)))
    for k in (96,160): cv(f'T+white{k} {b}',lambda f: cat(T,white(x,s,f,k)))
    for k in (64,96,160): cv(f'T+lda{k} {b}',lambda f: cat(T,lda(x,s,f,k)))
    cv(f'lda96 {b}',lambda f: lda(x,s,f,96))
