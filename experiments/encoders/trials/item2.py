import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
import numpy as np, cv2
from pathlib import Path
from experiments.encoders.train import configure
from anytouch_jax.data.images import decode
from anytouch_jax.data.transforms import subtract_background, touch_evaluation
names=configure(2,[],7,{"model.text":None}).simulated.sensors; print(names)
s=np.load('runs/d/sim.npz'); sub=np.load('runs/d/sim_sub.npy'); sen=s['sensor'].reshape(-1)
d=np.load('runs/d/rt2.npz'); 
def folder(p,gel):
    g=decode(Path(gel)); fs=sorted(x for x in Path(p).glob('*.*') if x.suffix in('.png','.jpg') and x.name!=Path(gel).name)
    return np.stack([touch_evaluation([subtract_background([decode(f)],g)[0]],112)[0] for f in fs])
import glob
print(os.listdir('/work/shared/real_touch3/fots-digit')[:4],os.listdir('/work/shared/real_touch3/fots-gelsight')[:4])
def gelof(p): 
    return [f for f in glob.glob(p+'/*') if 'b' in os.path.basename(f).lower() and ('back' in f or 'bg' in f or 'ref' in f or 'base' in f)][0]
sets={}
for n,p in (('real fots digit','/work/shared/real_touch3/fots-digit'),('real fots gelsight','/work/shared/real_touch3/fots-gelsight')):
    sets[n]=folder(p,gelof(p))
touched=(d['score']>7)&(d['split']=='train'); idx=np.flatnonzero(touched)[::6]; sets['real mini dots']=d['sub'][idx]
R=Path('/work/shared/real_touch/gelslam-gelsight_mini'); g=decode(R/'background.png'); sets['real mini gelslam']=np.stack([touch_evaluation([subtract_background([decode(f)],g)[0]],112)[0] for f in sorted(R.glob('*mm/*.png'))])
for i,n in enumerate((*names,'wild')): sets['sim '+n]=sub[sen==i][:300]
def stats(x):
    f=x.astype(np.float32)-128; L=f.mean(-1)
    w=np.hanning(112)[:,None]*np.hanning(112); P=np.abs(np.fft.fft2((L-L.mean((1,2),keepdims=True))*w))**2
    k=np.hypot(*np.meshgrid(np.fft.fftfreq(112),np.fft.fftfreq(112))); b=np.digitize(k,[.02,.05,.1,.2,.3,.4,.5])
    spec=np.stack([np.log10(P[:,b==j].mean(1)+1e-9) for j in range(1,7)],1)
    hp=L-np.stack([cv2.GaussianBlur(a,(0,0),1) for a in L]); noise=np.median(np.abs(hp),(1,2))/.6745
    C=f-f.mean((1,2),keepdims=True); col=1-np.abs(np.stack([np.corrcoef(a.reshape(-1,3).T)[[0,0,1],[1,2,2]] for a in C])).mean(1)
    gy,gx=np.gradient(L,axis=(1,2)); sharp=np.percentile(np.hypot(gy,gx),99,axis=(1,2))
    return dict(spec=spec,noise=noise,std=f.std((1,2,3)),mean=f.mean((1,2)),colour=col,sharp=sharp,smooth=np.stack([cv2.GaussianBlur(a,(0,0),12).std() for a in L]))
S={n:stats(x) for n,x in sets.items()}
for n,t in S.items(): print(f"{n:22s} n={len(sets[n]):4d} std {np.median(t['std']):5.1f} noise {np.median(t['noise']):4.2f} sharp99 {np.median(t['sharp']):5.2f} smooth {np.median(t['smooth']):4.2f} mean {np.round(t['mean'].mean(0),1)} +- {np.round(t['mean'].std(0),1)} colour {np.median(t['colour']):.2f} spec {np.round(np.median(t['spec'],0),2)}")
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
def F(n,keys): return np.concatenate([S[n][k].reshape(len(sets[n]),-1) for k in keys],1)
for a,b in (('real mini dots','sim gelsight_mini'),('real mini gelslam','sim gelsight_mini'),('real fots gelsight','sim gelsight_mini'),('real fots digit','sim digit')):
    for keys in (('mean',),('std',),('spec',),('noise',),('sharp',),('smooth',),('colour',),('spec','noise','sharp','smooth','colour','std','mean')):
        x=np.concatenate([F(a,keys),F(b,keys)]); y=np.r_[np.ones(len(sets[a])),np.zeros(len(sets[b]))]
        print(a,'|',b,'+'.join(keys),'%.0f %%'%(100*cross_val_score(make_pipeline(StandardScaler(),LogisticRegression(class_weight='balanced')),x,y,cv=5,scoring='balanced_accuracy').mean()))
