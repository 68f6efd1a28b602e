import sys
from e11 import *
import e11
F=np.load(sys.argv[1]); m=F['mean']; raw=blk(m,0,1,2,4,7); tr=D.split=='train'
mu,sg=raw[tr].mean(0),raw[tr].std(0)+1e-6; X=((raw-mu)/sg).astype(np.float32)
q=F['sim']; q=np.concatenate([q[:,c[b]:c[b+1]] for b in (0,1,2,4,7)],1); Q=(q-mu)/sg; e11.qs=Q.reshape(-1,2,q.shape[1])
s=np.load('runs/d/sim.npz'); sen=s['sensor'].reshape(-1); ob=np.repeat(s['object'],2)
Tm=np.load('runs/d/f_tiny_sim.npy')
def loo(Z,sel):
    o=ob[sel]; z=Z[sel]; z=(z-z.mean(0))/(z.std(0)+1e-6)
    # ridge to object one-hot needs >=3; use whitened-free cosine 1-NN
    z=z/np.linalg.norm(z,axis=1,keepdims=True); S_=z@z.T; np.fill_diagonal(S_,-9)
    has=np.array([(o==a).sum()>1 for a in o]); return 100*(o[S_.argmax(1)]==o)[has].mean(), has.sum()
# projection fitted on real train
Xall=np.concatenate([X,Q]); fitmask=np.concatenate([tr,np.zeros(len(Q),bool)])
def proj(k):
    n=len(X); # reuse lda3 by temporarily applying linear map: recover P via lstsq
    Z=lda3(X,tr,k,a=.5); P=np.linalg.lstsq(np.c_[X,np.ones(n)],Z,rcond=None)[0]; return np.c_[Q,np.ones(len(Q))]@P
for i,nm in ((0,'mini'),(1,'digit'),(2,'gelsight'),(3,'gelslim')):
    sel=sen==i; print(nm,'T %.1f'%loo(Tm,sel)[0],'X %.1f'%loo(Q,sel)[0],'T+X %.1f'%loo(np.c_[Tm/Tm.std(0),Q/Q.std(0)],sel)[0],*['X%d %.1f T+ %.1f'%(k,loo(proj(k),sel)[0],loo(np.c_[Tm/Tm.std(0),proj(k)/proj(k).std(0)],sel)[0]) for k in (64,96,128)],loo(Tm,sel)[1],flush=True)
