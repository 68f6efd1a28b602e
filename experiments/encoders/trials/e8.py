from e6 import *
st=lambda x,f: (x-x[f].mean(0))/(x[f].std(0)+1e-6)
Q=np.load('runs/d/f_states.npy'); n=192*7; cls=lambda i: Q[:,192*i:192*(i+1)]; mn=lambda i: Q[:,n+192*i:n+192*(i+1)]
g=np.load('runs/d/f_grey.npy'); c=np.cumsum([0,16,24,24,40,40,80,80,80]); GS=std(np.concatenate([g[:,c[b]:c[b+1]] for b in (0,1,2,4,7)],1))
cat=lambda *a: np.concatenate(a,1)
def val(x):  # val recordings only, both directions, trained on train
    r=[]
    best=None
    for i in range(len(LAM)):
        cor=[]
        for a,b in (('cam0','cam2'),('cam2','cam0')):
            fit=np.flatnonzero((D.split=='train')&(D.finger==a)); v=ridge_path(x,yo,39,fit,scores._share_weights(D.recording[fit]))[i]
            te=(D.split=='val')&(D.finger==b); nn=np.unique(D.recording[te]); m_=np.stack([v[te&(D.recording==q)].mean(0) for q in nn]); t=np.array([yo[te&(D.recording==q)][0] for q in nn]); cor.append(m_.argmax(1)==t)
        r.append(np.concatenate(cor).mean())
    return max(r)
def go(name,make):
    f=D.split=='train'; print(f'VAL finger {100*val(make(f)):5.1f}',end='  '); cvp(name,make)
go('tiny',lambda f: std(tiny)); go('S',lambda f: S); go('S lda96',lambda f: st(lda(S,f,96),f))
go('grey S lda 96',lambda f: st(lda(GS,f,96),f)); go('S+grey lda 128',lambda f: st(lda(cat(S,GS),f,128),f))
for i in (2,3,4,5): go(f'mean state {i}',lambda f: std(mn(i)))
go('cls 4',lambda f: std(cls(4))); go('mean3 lda96',lambda f: st(lda(std(mn(3)),f,96),f))
go('mean 2,3,4 lda96',lambda f: st(lda(std(cat(mn(2),mn(3),mn(4))),f,96),f))
go('T+S lda 96',lambda f: cat(std(tiny),st(lda(S,f,96),f)))
go('T+S lda 48',lambda f: cat(std(tiny),st(lda(S,f,48),f)))
