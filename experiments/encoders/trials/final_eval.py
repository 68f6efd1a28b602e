# final_eval.py feats.npz : choose k on CV
import sys
from e11 import *
import e11
F=np.load(sys.argv[1]); m=F['mean']; raw=blk(m,0,1,2,4,7); tr=D.split=='train'
mu,sg=raw[tr].mean(0),raw[tr].std(0)+1e-6; X=((raw-mu)/sg).astype(np.float32)
q=F['sim']; q=np.concatenate([q[:,c[b]:c[b+1]] for b in (0,1,2,4,7)],1); e11.qs=((q-mu)/sg).reshape(-1,2,q.shape[1])
C=std(tiny[:,:192])
go('X',lambda f: X)
for k in (64,96,128):
    go(f'X {k}',lambda f: st(lda3(X,f,k,a=.5),f)); cvp(f'   T+X {k}',lambda f: cat(T,st(lda3(X,f,k,a=.5),f)))
    cvp(f'   C+X {k}',lambda f: cat(C,st(lda3(X,f,k,a=.5),f)))
