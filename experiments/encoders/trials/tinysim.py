import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
import numpy as np
from anytouch_jax.encoder.encoder import load_encoder
from experiments.encoders.train import configure
names=configure(2,[],7,{"model.text":None}).simulated.sensors
enc=load_encoder('anytouch-tiny',engine='onnxruntime'); x=np.load('runs/d/sim_sub.npy'); s=np.load('runs/d/sim.npz')['sensor'].reshape(-1)
rows=np.array([enc.sensor_row(n) for n in names]+[enc.config.model.universal_row])[s].astype(np.int32)
np.save('runs/d/f_tiny_sim.npy',np.concatenate([enc.encode_touch(x[i:i+64],rows[i:i+64]) for i in range(0,len(x),64)]))
