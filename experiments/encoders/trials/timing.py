import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
import numpy as np, time
from anytouch_jax.encoder.encoder import load_encoder
N='/work/distil/runs/d/w1/anytouch-tiny'
E={'old xla':load_encoder('anytouch-tiny',engine='xla'),'new xla':load_encoder(N,engine='xla'),'old ort':load_encoder('anytouch-tiny',engine='onnxruntime'),'new ort':load_encoder(N,engine='onnxruntime')}
x=np.load('/work/distil/runs/d/rt2.npz')['sub'][:64]
for B,n in ((1,250),(8,40)):
    T={k:[] for k in E}
    for e in E.values(): e.encode_touch(x[:B],'gelsight_mini')
    for _ in range(n):
        for k,e in E.items():
            t=time.perf_counter(); e.encode_touch(x[:B],'gelsight_mini'); T[k].append(time.perf_counter()-t)
    print(B,{k:(round(1e3*min(v),2),round(1e3*float(np.percentile(v,10)),2),round(1e3*float(np.median(v)),2)) for k,v in T.items()},flush=True)
a,b=(E[k].encode_touch(x,'gelsight_mini') for k in ('old xla','new xla')); c=E['new ort'].encode_touch(x,'gelsight_mini'); print('bit-equal',np.array_equal(a,b[:,:192]),'ort off',np.abs(b-c).max()/np.abs(b).max(),'sight std',b[:,192:].std(0).mean(),'class std',a.std(0).mean())
