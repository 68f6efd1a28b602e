from train import *
import datetime
last=10; start=sys.argv[1]
until=lambda h,m: -max(1,(datetime.datetime.now().replace(hour=h,minute=m,second=0)-datetime.datetime.now()).total_seconds())
torch.manual_seed(1); T=teacher(last); S=Net(last,True).to(memory_format=torch.channels_last); st=Stream(1)
scaled_start(S,T,st)
S.load_state_dict(torch.load('state.pt'))
sets=held()
if start=='B': run(S,T,st,64,16,until(15,7),2e-3,0,'adam','fold',sets=None,every=20,out='state.pt',anneal=True,floor=.2); torch.save(S.state_dict(),'B.pt'); S.eval(); show(R2(S,T,sets)); S.eval()
st.share=.6
run(S,T,st,112,12,until(15,23),8e-4,0,'adam','fold',sets=sets,every=20,out='state.pt',anneal=True,floor=.02)
torch.save(S.state_dict(),'C.pt')
