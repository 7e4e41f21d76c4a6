// Hand-written single-track batches, the limit the lanes are measured against: 8 predictions to a vector, NV vectors at
// a time, whole trajectories in registers, the same polynomials as st_core/backends/numba_ops.py. Built by
// bench/batch.py for this machine only. Table layout as in st_core/start_grid.py: w[field][offset(k) + start].
#include <cstdint>
#include <cstring>
#include <cmath>
#ifndef NV
#define NV 1
#endif
typedef double D __attribute__((vector_size(64)));
typedef int64_t I __attribute__((vector_size(64)));
static inline D set1(double x){ return D{x,x,x,x,x,x,x,x}; }
static inline D ld(const double*p){ D r; memcpy(&r,p,64); return r; }
static inline void st(double*p, D v){ memcpy(p,&v,64); }
static inline I bits(D x){ return (I)x; }
static inline D val(I x){ return (D)x; }
static inline D absd(D x){ return val(bits(x) & 0x7fffffffffffffffLL); }
struct SC{D s,c;};
static inline SC sincos(D x){
  D sh = x*0.6366197723675814 + 6755399441055744.0;
  I q = bits(sh); D n = sh - 6755399441055744.0;
  D r = (x - n*1.5707963267341256) - n*6.077100506506192e-11;
  D z=r*r;
  D z2=z*z, z4=z2*z2;
  D ps = (-0.16666666666666666+z*0.008333333333330905) + z2*(-0.00019841269836710015+z*2.755731608182638e-06) + z4*(-2.5051128069891774e-08+z*1.591788278413412e-10);
  D pc = (0.04166666666666657+z*-0.0013888888888865072) + z2*(2.4801587282473078e-05+z*-2.755731205923296e-07) + z4*(2.087538637959625e-09+z*-1.1341301033703834e-11);
  D s = r + r*z*ps; D c = (1.0 - 0.5*z) + z2*pc;
  I odd = (q & 1) != 0;
  D ss = odd ? c : s, cc = odd ? s : c;
  return { val(bits(ss) ^ ((q & 2) << 62)), val(bits(cc) ^ (((q+1) & 2) << 62)) };
}
static inline D sin_(D x){ return sincos(x).s; }
static inline D atan_(D x){
  D a=absd(x); I small = a < 1.0; I mid = (a > 0.2679491924311227) & (a < 3.732050807568877); D one=set1(1.0), zero=set1(0.0);
  D u = val(bits(one) | (bits(x) & (int64_t)0x8000000000000000ULL));
  D n = small ? x : -u, d = small ? one : a;
  D c = mid ? (small ? u*-0.5773502691896257 : u*0.5773502691896257) : zero;
  D t = (n + c*d)/(d - c*n);
  D base = mid ? (small ? u*0.5235987755982989 : u*1.0471975511965979) : (small ? zero : u*1.5707963267948966);
  D z=t*t, z2=z*z, z4=z2*z2;
  D p = ((-0.3333333333333324+z*0.1999999999984203) + z2*(-0.14285714239428257+z*0.11111105932082634)) + z4*((-0.09090623565675247+z*0.0768371258882859)+z2*(-0.06521798362425968+z*0.04577471134842663));
  return (base + t) + t*z*p;
}
static inline D sgn(D x){ D one=set1(1.0), z=set1(0.0); return x>0.0? one : (x<0.0? -one : z); }
static inline D max_(D a,double b){ return a > b ? a : set1(b); }

struct Kin { enum{NW=3}; double l, lr;
  template<int V> static void run(const double*p, const double*s0, int64_t ns, const double*w, int64_t fs, const int64_t*off, int steps, double h, double*out, int64_t i){
    D x[V],y[V],v[V],psi[V];
    for(int k=0;k<V;k++){x[k]=ld(s0+0*ns+i+8*k);y[k]=ld(s0+1*ns+i+8*k);v[k]=ld(s0+2*ns+i+8*k);psi[k]=ld(s0+4*ns+i+8*k);}
    D h2=set1(0.5*h), h6=set1(h/6), hh=set1(h);
    for(int n=0;n<steps;n++){
      const double*wa=w+off[2*n]+i,*wm=w+off[2*n+1]+i,*wb=w+off[2*n+2]+i;
      _Pragma("GCC unroll 1") for(int k=0;k<V;k++){
        D b0=ld(wa+8*k),c0=ld(wa+fs+8*k),a0=ld(wa+2*fs+8*k);
        D b1=ld(wm+8*k),c1=ld(wm+fs+8*k),a1=ld(wm+2*fs+8*k);
        D b2=ld(wb+8*k),c2=ld(wb+fs+8*k),a2=ld(wb+2*fs+8*k);
        D va=v[k], vb=va+h2*a0, vc=va+h2*a1, vd=va+hh*a1;
        D ra=va*c0, rb=vb*c1, rc=vc*c1, rd=vd*c2;
        SC A=sincos(psi[k]+b0), B=sincos(psi[k]+h2*ra+b1), C=sincos(psi[k]+h2*rb+b1), E=sincos(psi[k]+hh*rc+b2);
        x[k]+=h6*(va*A.c+2.0*(vb*B.c+vc*C.c)+vd*E.c);
        y[k]+=h6*(va*A.s+2.0*(vb*B.s+vc*C.s)+vd*E.s);
        psi[k]+=h6*(ra+2.0*(rb+rc)+rd);
        v[k]=va+h6*(a0+4.0*a1+a2);
      }
    }
    for(int k=0;k<V;k++){st(out+0*ns+i+8*k,x[k]);st(out+1*ns+i+8*k,y[k]);st(out+2*ns+i+8*k,v[k]);st(out+4*ns+i+8*k,psi[k]);
      st(out+3*ns+i+8*k, ld(s0+3*ns+i+8*k)); st(out+5*ns+i+8*k, ld(s0+5*ns+i+8*k));}
  }};
struct Lin { enum{NW=3};
  // p: m, Iz, lf, lr, Cf, Cr, veps
  struct P{ double lf,lr,cf,cr,eps,im,lfi,lri; P(const double*p):lf(p[2]),lr(p[3]),cf(p[4]),cr(p[5]),eps(p[6]),im(1/p[0]),lfi(p[2]/p[1]),lri(p[3]/p[1]){} };
  struct Wt{ D s,c,a; }; static Wt get(const double*w,int64_t fs){return {ld(w),ld(w+fs),ld(w+2*fs)};}
  static inline void forces(const P&p, const Wt&w, D af, D ar, D&F, D&R){ F=-p.cf*af; R=-p.cr*ar; } };
struct Mf { enum{NW=9};
  // p: m, Iz, lf, lr, h, veps, front(13), rear(13): F0 cy dy1 dy2 ey1 ey2 ey3 ky1 ky2 ky4 lky lcy lmuy
  struct P{ double lf,lr,eps,im,lfi,lri,Cf,Cr,e3f,e3r; P(const double*p):lf(p[2]),lr(p[3]),eps(p[5]),im(1/p[0]),lfi(p[2]/p[1]),lri(p[3]/p[1]),
     Cf(p[7]*p[17]),Cr(p[20]*p[30]),e3f(p[12]),e3r(p[25]){} };
  struct Wt{ D s,c,a,bf,df,ef,br,dr,er; }; static Wt get(const double*w,int64_t fs){return {ld(w),ld(w+fs),ld(w+2*fs),ld(w+3*fs),ld(w+4*fs),ld(w+5*fs),ld(w+6*fs),ld(w+7*fs),ld(w+8*fs)};}
  static inline D mf(D a,D B,D Dd,D E,double C,double e3){ D x=B*a; D e=E*(1.0-e3*sgn(a)); return Dd*sin_(C*atan_(x-e*(x-atan_(x)))); }
  static inline void forces(const P&p, const Wt&w, D af, D ar, D&F, D&R){ F=mf(af,w.bf,w.df,w.ef,p.Cf,p.e3f); R=mf(ar,w.br,w.dr,w.er,p.Cr,p.e3r); } };
template<class M> struct Dyn { enum{NW=M::NW}; typedef typename M::P P; typedef typename M::Wt Wt;
  static inline void rhs(const P&p,const Wt&w, D vx,D vy,D psi,D r, D&dx,D&dy,D&dvy,D&dr){
    D lat=vy+p.lf*r;
    D af=atan_((lat*w.c-vx*w.s)/max_(absd(vx*w.c+lat*w.s),p.eps));
    D ar=atan_((vy-p.lr*r)/max_(absd(vx),p.eps));
    D F,R; M::forces(p,w,af,ar,F,R);
    SC y=sincos(psi); D f=F*w.c;
    dx=vx*y.c-vy*y.s; dy=vx*y.s+vy*y.c; dvy=(f+R)*p.im-vx*r; dr=p.lfi*f-p.lri*R;
  }
  template<int V> static void run(const double*pp, const double*s0, int64_t ns, const double*w, int64_t fs, const int64_t*off, int steps, double h, double*out, int64_t i){
    P p(pp); D x[V],y[V],v[V],u[V],psi[V],r[V];
    for(int k=0;k<V;k++){const double*s=s0+i+8*k; x[k]=ld(s);y[k]=ld(s+ns);v[k]=ld(s+2*ns);u[k]=ld(s+3*ns);psi[k]=ld(s+4*ns);r[k]=ld(s+5*ns);}
    D h2=set1(.5*h),h6=set1(h/6),hh=set1(h);
    for(int n=0;n<steps;n++) {
#define FORV _Pragma("GCC unroll 1") for(int k=0;k<V;k++)
      D sx[V],sy[V],su[V],sp[V],sr[V],sv[V], cu[V],cp[V],cr[V],cv[V], dx,dy,du,dr; D ax1[V];
      FORV { Wt a=M::get(w+off[2*n]+i+8*k,fs); rhs(p,a,v[k],u[k],psi[k],r[k],dx,dy,du,dr);
        sx[k]=dx;sy[k]=dy;su[k]=du;sp[k]=r[k];sr[k]=dr;sv[k]=a.a; cv[k]=v[k]+h2*a.a;cu[k]=u[k]+h2*du;cp[k]=psi[k]+h2*r[k];cr[k]=r[k]+h2*dr; }
      FORV { Wt m=M::get(w+off[2*n+1]+i+8*k,fs); rhs(p,m,cv[k],cu[k],cp[k],cr[k],dx,dy,du,dr);
        sx[k]+=2.0*dx;sy[k]+=2.0*dy;su[k]+=2.0*du;sp[k]+=2.0*cr[k];sr[k]+=2.0*dr; D q=cr[k]; cv[k]=v[k]+h2*m.a;cu[k]=u[k]+h2*du;cp[k]=psi[k]+h2*q;cr[k]=r[k]+h2*dr; }
      FORV { Wt m=M::get(w+off[2*n+1]+i+8*k,fs); rhs(p,m,cv[k],cu[k],cp[k],cr[k],dx,dy,du,dr);
        sx[k]+=2.0*dx;sy[k]+=2.0*dy;su[k]+=2.0*du;sp[k]+=2.0*cr[k];sr[k]+=2.0*dr;sv[k]+=4.0*m.a; D q=cr[k]; cv[k]=v[k]+hh*m.a;cu[k]=u[k]+hh*du;cp[k]=psi[k]+hh*q;cr[k]=r[k]+hh*dr; }
      FORV { Wt b=M::get(w+off[2*n+2]+i+8*k,fs); rhs(p,b,cv[k],cu[k],cp[k],cr[k],dx,dy,du,dr);
        x[k]+=h6*(sx[k]+dx);y[k]+=h6*(sy[k]+dy);u[k]+=h6*(su[k]+du);psi[k]+=h6*(sp[k]+cr[k]);r[k]+=h6*(sr[k]+dr);v[k]+=h6*(sv[k]+b.a); }
    }
    FORV {double*o=out+i+8*k; st(o,x[k]);st(o+ns,y[k]);st(o+2*ns,v[k]);st(o+3*ns,u[k]);st(o+4*ns,psi[k]);st(o+5*ns,r[k]);}
  }};
template<class M> static void all(const double*p,const double*s0,int64_t ns,const double*w,int64_t fs,const int64_t*off,int steps,double h,double*out){
  for(int64_t i=0;i<ns;i+=8*NV) M::template run<NV>(p,s0,ns,w,fs,off,steps,h,out,i);
}
extern "C" {
void kinematic(const double*p,const double*s0,int64_t ns,const double*w,int64_t fs,const int64_t*off,int steps,double h,double*out){ all<Kin>(p,s0,ns,w,fs,off,steps,h,out);}
void linear(const double*p,const double*s0,int64_t ns,const double*w,int64_t fs,const int64_t*off,int steps,double h,double*out){ all<Dyn<Lin>>(p,s0,ns,w,fs,off,steps,h,out);}
void nonlinear(const double*p,const double*s0,int64_t ns,const double*w,int64_t fs,const int64_t*off,int steps,double h,double*out){ all<Dyn<Mf>>(p,s0,ns,w,fs,off,steps,h,out);}
}
