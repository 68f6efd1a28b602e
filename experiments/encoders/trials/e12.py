from e8_defs import *
import sys
m=np.load(sys.argv[1])['mean']; X=std(blk(m,0,1,2,4,7)); T=std(tiny)
fast('student S',X); go('student S lda96',lambda f: st(lda(X,f,96),f)); fast('T+S',cat(T,X))
for b in ((4,),(7,),(2,4,7)): fast(str(b),std(blk(m,*b)))
