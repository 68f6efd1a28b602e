from e11 import *
C=std(tiny[:,:192])
for n,x in (('class',C),('class+S raw',cat(C,S))): fast(n,x)
for k,a in ((64,.5),(96,.5),(128,.5),(160,.5),(184,.5)):
    cvp(f'class+lda3 {k} a={a}',lambda f: cat(C,st(lda3(S,f,k,a=a),f)))
