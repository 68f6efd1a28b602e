from ridge import *
h=np.load('runs/d/f_tiny_h.npy'); v=np.load('runs/d/f_tiny_v.npy')
def fing(name,x): 
    o=cvr(x,yo,39,P_obj); f=cvr(x,yo,39,P_fin); print(name,'obj %.1f finger %.1f'%(100*o[0],100*f[0]),flush=True)
fing('tiny',std(tiny)); fing('mean h',std(tiny+h)); fing('mean v',std(tiny+v)); 
