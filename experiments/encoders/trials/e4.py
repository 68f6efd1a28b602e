from ridge import *
m=np.load('runs/d/f224.npz')['mean']; q=np.load('runs/d/f112.npz')['mean']
for n,z in (('224',m),('112',q)):
    for b in ((4,),(7,),(10,),(2,4,7),(4,7,10),(4,7,10,14),(0,1,2,4,7)):
        fast(n+' '+str(b),std(blk(z,*b)))
J=lambda *a: np.concatenate([std(tiny),*a],1)
fast('224 joined 4,7,10',J(std(blk(m,4,7,10))))
