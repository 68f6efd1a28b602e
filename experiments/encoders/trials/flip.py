import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
import numpy as np
from anytouch_jax.encoder.encoder import load_encoder
enc=load_encoder('anytouch-tiny',engine='onnxruntime')
s=np.load('/work/distil/runs/d/rt2.npz')['sub']; r=np.full(64,enc.sensor_row('gelsight_mini'))
for n,g in (('h',s[:,:,::-1]),('v',s[:,::-1])):
    x=np.concatenate([enc.encode_touch(np.ascontiguousarray(g[i:i+64]),r[:len(g[i:i+64])],pooling='both') for i in range(0,len(g),64)])
    np.save(f'/work/distil/runs/d/f_tiny_{n}.npy',x)
