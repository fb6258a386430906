"""python robust.py weights out.json [clips]: robustness of a tracker."""
import sys, json, numpy as np, cv2, time
import tapip3d_lite as t3d
from tapip3d_lite.evaluation.lite_splits import benchmark_clips
from tapip3d_lite.simulate.degrade import SensorConfig, degrade
from tapip3d_lite.training.motion import move
from tapip3d_lite.geometry import invert
from tapip3d_lite.clip import Clip

def jitter(clip, deg, seed):
    rng=np.random.default_rng(seed); T=len(clip)
    ax=rng.normal(size=(T,3)); ax/=np.linalg.norm(ax,axis=-1,keepdims=True)
    E=np.repeat(np.eye(4)[None],T,0)
    for t in range(T): E[t,:3,:3]=cv2.Rodrigues(ax[t]*np.radians(deg)*rng.normal())[0]
    e=clip.extrinsics.astype(float)
    return move(clip, invert(E@e)@e)

def photo(speed, frames=32, seed=0):
    rng=np.random.default_rng(seed); S=128
    big=np.zeros((512,512,3),np.float32)
    for k in (4,8,16,32,64,128):
        big+=cv2.resize(rng.random((k,k,3),np.float32),(512,512),interpolation=cv2.INTER_CUBIC)*(1/ k**0.35)
    big=(255*(big-big.min())/(big.max()-big.min()))
    ang=rng.uniform(0,2*np.pi); d=np.array([np.cos(ang),np.sin(ang)])
    K=np.array([[128,0,63.5],[0,128,63.5],[0,0,1]],np.float32); z=5.0
    vid=[];
    for t in range(frames):
        s=d*speed*t
        M=np.float32([[1,0,192-s[0]],[0,1,192-s[1]]])
        vid.append(cv2.warpAffine(big,M,(S,S),flags=cv2.INTER_LINEAR|cv2.WARP_INVERSE_MAP).round().clip(0,255).astype(np.uint8))
    uv=np.stack(np.meshgrid(np.linspace(32,96,6),np.linspace(32,96,6)),-1).reshape(-1,2)
    def lift(p): return np.concatenate([(p-63.5)/128*z, np.full((len(p),1),z)],-1)
    q=np.concatenate([np.zeros((36,1)),lift(uv)],-1).astype(np.float32)
    clip=Clip(np.stack(vid),np.full((frames,S,S),z,np.float32),np.repeat(K[None],frames,0),np.repeat(np.eye(4,dtype=np.float32)[None],frames,0),queries=q)
    return clip,d*z/128

def slide(tr):
    out={}
    for v in (0.1,0.25,0.5,1,2,4):
        r7,r31=[],[]
        for seed in range(3):
            n=32 if v<=1 else 12
            clip,d=photo(v,n,seed); tk=tr.track(clip)
            mv=(tk.xyz[:,:,:2]-tk.xyz[0,:,:2])@(d/np.linalg.norm(d))/np.linalg.norm(d)  # px
            r7.append(np.median(mv[7])/(7*v)); r31.append(np.median(mv[n-1])/((n-1)*v))
        out[v]=(float(np.mean(r7)),float(np.mean(r31)))
    return out

if __name__=='__main__':
    tr=t3d.load_tracker(sys.argv[1]); n=int(sys.argv[3]) if len(sys.argv)>3 else 8
    res={'slide':slide(tr)}; print(res['slide'],flush=True)
    clips=benchmark_clips('moving-camera',n,progress=False)
    conds={'clean':lambda c,i:c,'pose0.5':lambda c,i:jitter(c,.5,i),'pose1':lambda c,i:jitter(c,1,i),'pose2':lambda c,i:jitter(c,2,i),
     'flicker2%':lambda c,i:degrade(c,SensorConfig(flicker=.02),i),'noise1%':lambda c,i:degrade(c,SensorConfig(noise=.01),i),'noise5%':lambda c,i:degrade(c,SensorConfig(noise=.05),i),
     'holes50%':lambda c,i:degrade(c,SensorConfig(dropout=.5),i),'blur2':lambda c,i:degrade(c,SensorConfig(blur=2),i)}
    for k,f in conds.items():
        sc=[t3d.evaluate(tr.track(f(c,i)),f(c,i)) for i,c in enumerate(clips)]
        res[k]={m:float(np.nanmean([s[m] for s in sc])) for m in ('AJ3D_none','APD3D_none','APD3D_none_dynamic','APD3D_none_static','OA')}
        print(k,{a:round(b,3) for a,b in res[k].items()},flush=True)
    json.dump(res,open(sys.argv[2],'w'))
