import cv2, numpy as np, glob, zipfile, os, sys, time
cv2.setNumThreads(1)
rng=np.random.default_rng(0); S=160
def crops(im,n):
    out=[]; h,w=im.shape[:2]; m=min(h,w)
    if m<64: return out
    for _ in range(n):
        z=int(np.exp(rng.uniform(np.log(min(m,130)),np.log(m+1)))); z=min(max(z,64),m)
        y,x=rng.integers(0,h-z+1),rng.integers(0,w-z+1); c=im[y:y+z,x:x+z]
        c=cv2.resize(c,(S,S),interpolation=cv2.INTER_AREA if z>S else cv2.INTER_CUBIC)
        if c.std()>3: out.append(c)
    return out
def rgb(im):
    if im is None: return None
    if im.dtype!=np.uint8: im=(im/257).astype(np.uint8)
    if im.ndim==2: im=np.repeat(im[...,None],3,-1)
    if im.shape[2]==4:
        a=im[...,3:].astype(np.float32)/255; bg=rng.uniform(0,255,3) if rng.random()<.6 else np.full(3,255.)
        im=(im[...,:3]*a+bg*(1-a)).astype(np.uint8)
    return np.ascontiguousarray(im[...,::-1])
files={p:sorted(sum((glob.glob(f'x/{p}/**/*.{e}',recursive=True) for e in ('jpg','jpeg','png','webp')),[])) for p in sorted(os.listdir('x'))}
photo,who=[],[]
for p in files:
    if p in('openclipart-png','openarena-data'): continue
    seen={}
    for f in files[p]:
        if os.path.getsize(f)<30000: continue
        k=f.split('/images/')[0] if '/images/' in f else f   # one size a picture
        if k in seen and os.path.getsize(seen[k])>=os.path.getsize(f): continue
        seen[k]=f
    for k,f in sorted(seen.items()):
        im=rgb(cv2.imread(f,cv2.IMREAD_UNCHANGED))
        if im is None: continue
        if max(im.shape)>2000: im=cv2.resize(im,None,fx=2000/max(im.shape[:2]),fy=2000/max(im.shape[:2]),interpolation=cv2.INTER_AREA)
        c=crops(im,60); photo+=c; who+=[len(set(who)) if False else hash(k)%100000]*len(c)
    print(p,len(seen),len(photo),flush=True)
np.save('photo.npy',np.stack(photo)); np.save('photo_who.npy',np.array(who))
tex=[]
for z in glob.glob('x/openarena-data/**/*.pk3',recursive=True):
    try: zf=zipfile.ZipFile(z)
    except Exception as e: print(z,e); continue
    for n in zf.namelist():
        if n.lower().endswith(('.jpg','.png','.tga')):
            im=cv2.imdecode(np.frombuffer(zf.read(n),np.uint8),cv2.IMREAD_UNCHANGED) 
            if im is None: continue
            im=rgb(im); tex+=crops(im,2)
print('textures',len(tex),flush=True)
if tex: np.save('tex.npy',np.stack(tex))
clip=[]
fs=files['openclipart-png']; fs=[fs[i] for i in rng.permutation(len(fs))[:3500]]
t=time.time()
for f in fs:
    if os.path.getsize(f)>1500000: continue
    im=cv2.imread(f,cv2.IMREAD_UNCHANGED)
    if im is None: continue
    if max(im.shape)>1000: im=cv2.resize(im,None,fx=1000/max(im.shape[:2]),fy=1000/max(im.shape[:2]),interpolation=cv2.INTER_AREA)
    im=rgb(im); clip+=crops(im,1)
    if time.time()-t>150: break
print('clip',len(clip)); np.save('clip.npy',np.stack(clip))
