import numpy as np, cv2, glob
cv2.setNumThreads(1)
D=''; W=''
def albums():
    z=np.load(D+'albums.npz'); out={}
    out['touch']=[(4,z['a']),(.8,z['b']),(.6,z['m']),(5.5,z['sm'])]
    ph=np.load(W+'photo.npy'); who=np.load(W+'photo_who.npy'); hold=who%20==0
    wide=[(5,ph[~hold]),(2,z['dr'])]
    for n,w in (('tex',1.5),('clip',2)):
        try: wide.append((w,np.load(W+n+'.npy')[50:]))
        except FileNotFoundError: print('no',n)
    out['wide']=wide
    return out
def held():
    "pictures that are never learned from, 112 px"
    ph=np.load(W+'photo.npy'); who=np.load(W+'photo_who.npy'); ph=ph[who%20==0]; rng=np.random.default_rng(1)
    out={}
    ph=ph[rng.permutation(len(ph))[:160]]; out['photo']=np.stack([x[24:136,24:136] for x in ph])
    c=np.load(W+'clip.npy')[:50]; out['clip']=np.stack([cv2.resize(x,(112,112),interpolation=cv2.INTER_AREA) for x in c])
    r=np.load(D+'rt2.npz'); t=np.flatnonzero((r['split']=='test'))[::7]; out['mini test']=r['sub'][t]; out['mini plain']=r['plain'][t]
    h=np.load(W+'held_touch.npz')
    for k in h.files: out[k]=h[k]
    return out
def relief(x,rng):
    "a picture as a height map under coloured lights"
    h=cv2.GaussianBlur(x.mean(-1),(0,0),float(np.exp(rng.uniform(-.3,1.2)))); gx=cv2.Sobel(h,cv2.CV_32F,1,0); gy=cv2.Sobel(h,cv2.CV_32F,0,1)
    n=np.sqrt(gx*gx+gy*gy); g=np.exp(rng.uniform(-2,.3)); sat=1/(1+n/np.exp(rng.uniform(3,5.5))) if rng.random()<.6 else 1
    a=rng.uniform(0,2*np.pi)+np.array([0,2.1,4.2])+rng.normal(0,.4,3)
    y=128+g*(gx[...,None]*np.cos(a)+gy[...,None]*np.sin(a))*(sat[...,None] if not np.isscalar(sat) else 1)*np.exp(rng.normal(0,.3,3))
    if rng.random()<.4: y=y-(h-h.mean())[...,None]*rng.uniform(-.4,.4)
    return y
def one(x,other,s,wide,rng):
    if rng.random()<.08 and x.shape==other.shape: x=cv2.addWeighted(x,1.,other,-1.,128)
    n=x.shape[0]; m=np.eye(2)
    zoom=np.exp(rng.uniform(-.45,.35) if wide else rng.uniform(-.25,.5)); an=rng.normal(0,.15)+(rng.integers(4)*np.pi/2); st=np.exp(rng.normal(0,.08,2))
    m=zoom*np.array([[np.cos(an),-np.sin(an)],[np.sin(an),np.cos(an)]])*st[:,None]
    if rng.random()<.5: m[0]=-m[0]
    room=max(n-s/zoom,0)/2; c=n/2+rng.uniform(-1,1,2)*(room+.04*n); t=s/2-m@c
    x=cv2.warpAffine(x,np.c_[m,t],(s,s),flags=cv2.INTER_LINEAR,borderMode=cv2.BORDER_REFLECT_101).astype(np.float32)
    if wide:
        k=rng.random()
        if k<.3: x=relief(x,rng)
        elif k<.5: x=128+(x-cv2.GaussianBlur(x,(0,0),float(np.exp(rng.uniform(1,3)))))*np.exp(rng.normal(-.1,.6))
        elif k<.65: x=128+(x-x.mean((0,1)))*np.exp(rng.normal(-.8,.6))
    if rng.random()<.2: x=np.repeat(x.mean(-1,keepdims=True),3,-1)
    if rng.random()<.3: x=x[...,rng.permutation(3)]
    mid=x.mean((0,1)) if rng.random()<.5 else np.full(3,128.)
    if rng.random()<.7: x=(x-mid)*(np.exp(rng.normal(.1,.4))*np.exp(rng.normal(0,.15,3)))+mid+rng.normal(0,10)+rng.normal(0,8,3)*(rng.random()<.5)
    k=rng.random()
    if k<.12: x=cv2.GaussianBlur(np.ascontiguousarray(x),(0,0),float(rng.uniform(.4,1.8)))
    elif k<.3: x=x+rng.standard_normal(x.shape,dtype=np.float32)*rng.uniform(.5,6)
    return np.clip(x+.5,0,255).astype(np.uint8)
class Stream:
    def __init__(self,seed,share=.5):
        self.a=albums(); self.rng=np.random.default_rng(seed); self.share=share
    def draw(self,kind):
        al=self.a[kind]; w=np.array([v for v,_ in al]); p=al[self.rng.choice(len(al),p=w/w.sum())][1]; return p[self.rng.integers(len(p))]
    def batch(self,n,s):
        d=(np.arange(n)<self.share*n); out=[]
        for t in d:
            k='touch' if t else 'wide'; out.append(one(self.draw(k),self.draw(k),s,not t,self.rng))
        return np.stack(out),d
