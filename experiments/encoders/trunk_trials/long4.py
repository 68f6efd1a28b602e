from long3 import *
import train
old=train.stats
def tight(*a):
    sd,ms=old(*a); ms[True]=[.5*v for v in ms[True]]; return sd,ms
import long3; long3.stats=tight
S=Net(10,True); S.stem.plain=False
for b in S.blocks: b.narrow.plain=False
S=fold(S.eval()); S.load_state_dict(torch.load(sys.argv[1]))
for p in S.parameters(): p.requires_grad_(True)
torch.manual_seed(3); T=teacher(10); st=Stream(3); st.share=.7
run3(S,T,st,112,8,(15,28),.004,.03,'G112.pt',wm=1.0)
