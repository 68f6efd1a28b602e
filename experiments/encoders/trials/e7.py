from e6 import *
T=std(tiny); st=lambda x,f: (x-x[f].mean(0))/(x[f].std(0)+1e-6)
S2=std(blk(m,4,7)); S3=std(blk(m,0,1,2,4,7,10))
for k,sh in ((140,.1),(184,.1),(96,.03),(96,.3)):
    cvp(f'S lda {k} shr {sh}',lambda f: st(lda(S,f,k,sh),f))
cvp('S(0-7,10) lda 128',lambda f: st(lda(S3,f,128),f))
cvp('S(4,7) lda 96',lambda f: st(lda(S2,f,96),f))
f=D.split=='train'
for n,x in (('S lda96',st(lda(S,f,96),f)),('T+S lda96',np.concatenate([T,st(lda(S,f,96),f)],1)),('T+S',np.concatenate([T,S],1))):
    print(n,'TEST logistic obj finger slip',[round(100*v,1) for v in test(x)],flush=True)
