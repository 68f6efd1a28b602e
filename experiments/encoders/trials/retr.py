import numpy as np
T=np.load('runs/d/f_tiny_sim.npy').reshape(-1,2,192); q=np.load('runs/d/f_sim.npy'); c=np.cumsum([0,16,24,24,40,40,80,80,80]); q=np.concatenate([q[:,c[b]:c[b+1]] for b in (0,1,2,4,7)],1); q=((q-q.mean(0))/q.std(0)).reshape(-1,2,184)
sen=np.load('runs/d/sim.npz')['sensor']; print(T.shape,'norm of class',np.linalg.norm(T,axis=-1).mean(),'std per dim',T.std((0,1)).mean())
def rec(X):
    X=X-X.mean(0); X=X/np.linalg.norm(X,axis=-1,keepdims=True); r=[]
    for s in range(0,len(X)-49,50):
        A=X[s:s+50,0]@X[s:s+50,1].T; r+= list(A.argmax(1)==np.arange(50))
    return 100*np.mean(r)
sd=T.std((0,1)).mean()
for w in (0,.02,.05,.1,.2,.3,.5): print(w,round(rec(np.concatenate([T,w*sd*q],-1)),2))
