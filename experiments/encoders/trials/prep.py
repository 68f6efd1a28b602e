import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
import numpy as np, time
import anytouch_jax as at
from anytouch_jax.encoder.encoder import load_encoder
from experiments.real import recordings, features
data=recordings.read('/work/shared/real_touch2/manifest.csv')
enc=load_encoder('anytouch-tiny',engine='xla')
t=time.time()
sub=[];plain=[]
for fr,gel in data.pairs():
    sub.append(enc.prepare(fr,gel)); plain.append(enc.prepare(fr))
np.savez('/work/distil/runs/d/rt2.npz',sub=np.stack(sub),plain=np.stack(plain),recording=data.recording,finger=data.finger,split=data.split,fold=data.fold,object=data.object,slip=data.slip,group=data.manifest.text_column('grasp_group'),unit=data.manifest.text_column('unit'),score=data.manifest.number_column('label.contact_score'))
print('prep',time.time()-t)
t=time.time()
rows=np.full(len(sub),enc.sensor_row('gelsight_mini'))
s=np.stack(sub)
x=np.concatenate([enc.encode_touch(s[i:i+64],rows[i:i+64],pooling='both') for i in range(0,len(s),64)])
np.save('/work/distil/runs/d/f_tiny.npy',x); print(x.shape,time.time()-t)
