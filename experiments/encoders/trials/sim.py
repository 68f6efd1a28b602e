import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
import numpy as np, jax, time
from anytouch_jax.sim import endless
from anytouch_jax.simulated import SimulatedLoader, training_objects
from experiments.encoders.train import configure
config=configure(2,[],7,{"data.batch_size":16,"model.fields":0,"data.clip_share":0.0,"simulated.wild":.3,"simulated.reuse":1,"model.text":None} )
L=SimulatedLoader(config)
clips,gels,sens,obj=[],[],[],[]
t=time.time()
for step in range(int(sys.argv[1])):
    s=L.touches(step)
    clips.append(np.asarray(s.clip[:,:,0])); gels.append(np.asarray(s.background)); sens.append(np.asarray(s.sensor)); obj.append(np.asarray(s.object))
    if step%10==9 or step==1:
        print(step,time.time()-t,flush=True)
        np.savez('/work/distil/runs/d/sim_part.npz',clip=np.concatenate(clips),gel=np.concatenate(gels),sensor=np.concatenate(sens),object=np.concatenate(obj)); os.replace('/work/distil/runs/d/sim_part.npz','/work/distil/runs/d/sim.npz')
