from train import *
import datetime
last=10; start=sys.argv[1] if len(sys.argv)>1 else 'A'
until=lambda h,m: -max(1,(datetime.datetime.now().replace(hour=h,minute=m,second=0)-datetime.datetime.now()).total_seconds())
torch.manual_seed(0); T=teacher(last); S=Net(last,True).to(memory_format=torch.channels_last); st=Stream(0)
scaled_start(S,T,st)
if start!='A': S.load_state_dict(torch.load('state.pt'))
sets=held() 
if start=='A': run(S,T,st,64,16,until(14,27),8e-3,0,'adam','forced',every=20,out='state.pt',anneal=True,floor=.15); torch.save(S.state_dict(),'A.pt')
if start in 'AB': run(S,T,st,64,16,until(14,58),3e-3,0,'adam','chain',sets=sets,every=30,out='state.pt',anneal=True,floor=.2); torch.save(S.state_dict(),'B.pt')
st.share=.6
run(S,T,st,112,12,until(15,17),1.5e-3,0,'adam','fold',sets=sets,every=30,out='state.pt',anneal=True,floor=.02)
torch.save(S.state_dict(),'C.pt')
