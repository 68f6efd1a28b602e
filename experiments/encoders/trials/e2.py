from ridge import *
fast('tiny both',std(tiny)); fast('tiny class',std(tiny[:,:192]))
import sys
for n in sys.argv[1:]:
    q=np.load(f'runs/d/{n}.npz'); m=q['mean']
    fast(n+' 5,8,11,15',std(blk(m,5,8,11,15)))
    fast(n+' joined',np.concatenate([std(tiny),std(blk(m,5,8,11,15))],1))
    for b in ((2,),(4,),(7,),(10,),(14,),(2,4,7),(4,7,10)):
        fast(n+' '+str(b),std(blk(m,*b)))
    fast(n+' joined 4,7',np.concatenate([std(tiny),std(blk(m,4,7))],1))
