import e8_defs as E
from e8_defs import *
M24=std(cat(mn(2),mn(4))); 
go('S+mean24 lda 128',lambda f: st(lda(cat(S,M24),f,128),f))
go('S+mean24 lda 192',lambda f: st(lda(cat(S,M24),f,192),f))
go('S+mean24,cls24 lda 160',lambda f: st(lda(cat(S,M24,std(cat(cls(2),cls(4)))),f,160),f))
go('T+(S+mean24) lda 128',lambda f: cat(std(tiny),st(lda(cat(S,M24),f,128),f)))
go('cls+(S+mean24) lda 128',lambda f: cat(std(tiny[:,:192]),st(lda(cat(S,M24),f,128),f)))
f=D.split=='train'
a=st(lda(cat(S,M24),f,128),f); b=st(lda(cat(S,M24),f,192),f)
for n,x in (('lda128 alone',a),('T+lda128',cat(std(tiny),a)),('cls+lda128',cat(std(tiny[:,:192]),a)),('T+lda192',cat(std(tiny),b))):
    print(n,'TEST logistic obj finger slip',[round(100*v,1) for v in test(x)],flush=True)
