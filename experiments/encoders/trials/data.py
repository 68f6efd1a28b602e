import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
from experiments.encoders.distil import *
R=Path('/work/shared/real_touch'); R2=Path('/work/shared/real_touch2')
a=real_pictures(Path('/work/distil/runs/d/real/pack2/manifest.csv')); b=real_pictures(Path('/work/distil/runs/d/real/pack1/manifest.csv'))
m=np.concatenate([folder_pictures(f) for f in (R/'9dtact-9dtact',R/'allsight_sim-allsight',R/'aurova_grasping-digit',R/'tacto-digit',R/'normalflow-gelsight_mini',R2/'unical',R2/'9dtact_sensor_2',R2/'simtacls-taclink')])
ph=folder_pictures(R2/'incipient_slip-gelsight_mini_markers/object_photos')
rng=np.random.default_rng(5); t=time.time(); dr=np.stack([drawn_picture(rng) for _ in range(3000)]); print('drawn',time.time()-t)
s=np.load('/work/distil/runs/d/sim.npz'); c=s['clip'].reshape(-1,112,112,3); g=s['gel'].reshape(-1,112,112,3)
sm=np.concatenate([c,np.stack([subtract_background([x],y)[0] for x,y in zip(c,g)]),np.stack([subtract_background([x],y)[0] for x,y in zip(c,g)])])
# photographs at 384 px: crops
import glob
cr=[]
for f in sorted(glob.glob(str(R2/'incipient_slip-gelsight_mini_markers/object_photos/*'))):
    im=decode(Path(f))
    for _ in range(40):
        z=int(rng.integers(112,300)); y,x=rng.integers(0,im.shape[0]-z+1),rng.integers(0,im.shape[1]-z+1); cr.append(cv2.resize(im[y:y+z,x:x+z],(112,112),interpolation=cv2.INTER_AREA))
print(a.shape,b.shape,m.shape,ph.shape,dr.shape,sm.shape,len(cr))
np.savez('/work/distil/runs/d/albums.npz',a=a,b=b,m=m,ph=np.concatenate([ph,np.stack(cr)]),dr=dr,sm=sm)
# a sheet to look at
st=batches([(3,a),(1,b),(.7,m),(1,np.stack(cr)),(3,dr),(5,sm)],0); big=np.concatenate([next(st) for _ in range(3)]).reshape(6,8,112,112,3).transpose(0,2,1,3,4).reshape(6*112,8*112,3)
cv2.imwrite('/work/distil/runs/d/sheet.png',big[:,:,::-1])
