import sys; sys.path.insert(0,'src')
import numpy as np, glob
from pathlib import Path
from anytouch_jax.data.images import decode
from anytouch_jax.data import transforms as T
def get(fs,gel):
    g=decode(Path(gel)); fs=[Path(f) for f in fs]
    sub=np.stack([T.touch_evaluation([T.subtract_background([decode(f)],g)[0]],112)[0] for f in fs]); pl=np.stack([T.touch_evaluation([decode(f)],112)[0] for f in fs]); return sub,pl
R='real_touch3/'; out={}
import os
for n in ('digit','gelsight'):
    d=R+'fots-'+n; print(sorted(os.listdir(d))[-3:])
    bg=[f for f in glob.glob(d+'/*') if not os.path.basename(f)[0].isdigit()][0]
    out[n],out[n+' plain']=get(sorted(f for f in glob.glob(d+'/*.*') if f!=bg),bg)
N='real_touch/nc/mcubelab_gelslim-gelslim3/'
s=[]
for d in sorted(glob.glob(N+'*')):
    r=glob.glob(d+'/**/ref*',recursive=True); print(d,r)
    for q in r:
        fs=sorted(f for f in glob.glob(os.path.dirname(q)+'/**/*.*',recursive=True) if f!=q and f.endswith(('jpg','png')))
        if fs: s.append(get(fs,q)[0])
if s: out['gelslim']=np.concatenate(s)
print({k:v.shape for k,v in out.items()}); np.savez('held_touch.npz',**out)
