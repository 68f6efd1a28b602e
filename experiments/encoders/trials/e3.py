from ridge import *
q=np.load('runs/d/f112.npz'); m=q['mean']; sd=q['std']
J=lambda *a: np.concatenate([std(tiny),*a],1)
def pca(x,k):
    f=x[tv]; mu=f.mean(0); U,S,V=np.linalg.svd(f-mu,full_matrices=False); return ((x-mu)@V[:k].T/np.sqrt((S[:k]**2/len(f)).mean())).astype(np.float32)
fast('joined 2,4,7',J(std(blk(m,2,4,7))))
fast('joined 2,4,7 w.5',J(.5*std(blk(m,2,4,7))))
fast('joined 2,4,7 w.25',J(.25*std(blk(m,2,4,7))))
fast('joined 4,7,10',J(std(blk(m,4,7,10))))
fast('2,4,7 std only',std(blk(sd,2,4,7)))
fast('2,4,7 mean+std',np.concatenate([std(blk(m,2,4,7)),std(blk(sd,2,4,7))],1))
fast('joined 2,4,7 std',J(std(blk(sd,2,4,7))))
fast('joined 7',J(std(blk(m,7))))
fast('joined 6,7',J(std(blk(m,6,7))))
