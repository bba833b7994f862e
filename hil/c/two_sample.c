/* Two-sample body integrals and the geographic mechanization, normal gravity: the arithmetic of integrate_body (window 2) in
   nav/body_integrals.py and of advance in nav/mechanization/geographic.py, in plain C. What `hil bench` compares with. */
#include <math.h>

static const double A = 6378137.0, F = 1.0 / 298.257223563, GM = 3.986004418e14, RATE = 7.292115e-5;
static const double GE = 9.7803253359, GP = 9.8321849378, POLAR_CAP = 1e-3, PI = 3.14159265358979323846;
#define E2 (F * (2.0 - F))
#define B (A * (1.0 - F))
#define K (B * GP / (A * GE) - 1.0)
#define M (RATE * RATE * A * A * B / GM)

typedef struct { double x, y, z; } V;
typedef struct { double w, x, y, z; } Q;

static inline V cross(V a, V b) {
  V c = {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
  return c;
}

static inline Q turn_of(double x, double y, double z) {
  double a2 = x * x + y * y + z * z, s, w;
  if (a2 < 1e-3) {
    s = 0.5 - a2 * (1.0 / 48.0 - a2 * (1.0 / 3840.0 - a2 * (1.0 / 645120.0)));
    w = -a2 * (0.125 - a2 * (1.0 / 384.0 - a2 * (1.0 / 46080.0)));
  } else {
    double a = sqrt(a2);
    s = sin(0.5 * a) / a;
    w = sin(0.25 * a);
    w = -2.0 * w * w;
  }
  Q q = {w, s * x, s * y, s * z};
  return q;
}

static inline V change_by_turn(V p, V v) {
  double a2 = p.x * p.x + p.y * p.y + p.z * p.z, s, c;
  if (a2 < 1e-3) {
    s = 1.0 - a2 * (1.0 / 6.0 - a2 * (1.0 / 120.0 - a2 * (1.0 / 5040.0)));
    c = 0.5 - a2 * (1.0 / 24.0 - a2 * (1.0 / 720.0 - a2 * (1.0 / 40320.0)));
  } else {
    double a = sqrt(a2);
    s = sin(a) / a;
    c = (1.0 - cos(a)) / a2;
  }
  V t = cross(p, v), u = cross(p, t);
  V out = {s * t.x + c * u.x, s * t.y + c * u.y, s * t.z + c * u.z};
  return out;
}

static inline V rotate(Q q, V v) {
  V k = {q.x, q.y, q.z}, p = cross(k, v);
  p.x *= 2.0, p.y *= 2.0, p.z *= 2.0;
  V r = cross(k, p);
  V out = {v.x + q.w * p.x + r.x, v.y + q.w * p.y + r.y, v.z + q.w * p.z + r.z};
  return out;
}

static inline void radii(double s, double *meridian, double *prime) {
  double w2 = 1.0 - E2 * s * s;
  *prime = A / sqrt(w2);
  *meridian = *prime * (1.0 - E2) / w2;
}

static inline void gravitation(double s, double c, double height, double axis, double *north, double *down) {
  double s2 = s * s, out = RATE * RATE * axis, g0 = GE * (1.0 + K * s2) / sqrt(1.0 - E2 * s2);
  *north = out * s;
  *down = g0 * (1.0 - 2.0 / A * (1.0 + F + M - 2.0 * F * s2) * height + 3.0 * height * height / (A * A)) + out * c;
}

static inline void carry(double *sum, double *low) {
  double next = *sum + *low;
  *low -= next - *sum;
  *sum = next;
}

/* memory: step, dtheta, dvel of the sample before (7). state: as in geographic.py (16). Steps done. */
long two_sample(double *memory, double *state, long n, const double *step, const double *dtheta, const double *dvel,
                const double *bias, double *position, double *velocity, double *attitude) {
  double lat = state[0], lon = state[1], height = state[2], vn = state[3], ve = state[4], vd = state[5];
  Q q = {state[6], state[7], state[8], state[9]};
  double lat_low = state[10], lon_low = state[11];
  Q low = {state[12], state[13], state[14], state[15]};
  double t0 = memory[0];
  V p0 = {memory[1], memory[2], memory[3]}, u0 = {memory[4], memory[5], memory[6]};
  long done = n;
  for (long k = 0; k < n; k++) {
    double t = step[k], sl = sin(lat), cl = cos(lat);
    if (cl < POLAR_CAP) {
      done = k;
      break;
    }
    if (t > 0.0) {
      /* Body integrals. */
      V th = {dtheta[3 * k] - bias[0] * t, dtheta[3 * k + 1] - bias[1] * t, dtheta[3 * k + 2] - bias[2] * t};
      V f = {dvel[3 * k], dvel[3 * k + 1], dvel[3 * k + 2]};
      double c = t0 > 0.0 ? t * t / (6.0 * t0 * (t + t0)) : 0.0, r = t0 > 0.0 ? t / t0 : 0.0, b = r / (1.0 + r) / 6.0;
      V cone = cross(p0, th), a = cross(th, f), s = cross(p0, f), o = cross(u0, th), e = cross(th, a);
      Q dq = turn_of(th.x + c * cone.x, th.y + c * cone.y, th.z + c * cone.z);
      V dv = {f.x + 0.5 * a.x + c * (s.x + o.x) + e.x / 6.0, f.y + 0.5 * a.y + c * (s.y + o.y) + e.y / 6.0,
              f.z + 0.5 * a.z + c * (s.z + o.z) + e.z / 6.0};
      V ds = {t * (0.5 * f.x - b * (f.x - r * u0.x) + a.x / 6.0), t * (0.5 * f.y - b * (f.y - r * u0.y) + a.y / 6.0),
              t * (0.5 * f.z - b * (f.z - r * u0.z) + a.z / 6.0)};
      t0 = t, p0 = th, u0 = f;

      V u = rotate(q, dv), d = rotate(q, ds);
      double meridian, prime, unused, prime_m;
      radii(sl, &meridian, &prime);
      double axis = (prime + height) * cl, turn = RATE * t, vi = ve + RATE * axis, half = 0.5 * t;
      double hn = half * vn + 0.25 * d.x, he = half * ve + 0.25 * d.y, hd = half * vd + 0.25 * d.z;
      double gn0, gd0, gn, ge, gd;
      gravitation(sl, cl, height, axis, &gn0, &gd0);
      double dlat = (hn - 0.125 * t * t * sl * vi * vi / axis) / (meridian + height), dlon = he / axis;
      double sm = sl + dlat * (cl - 0.5 * dlat * sl), cm = cl - dlat * (sl + 0.5 * dlat * cl);
      double hm = height - hd - 0.125 * t * t * (gd0 - cl * vi * vi / axis - vn * vn / (meridian + height));
      radii(sm, &unused, &prime_m);
      gravitation(sm, cm, hm, (prime_m + hm) * cm, &gn, &gd);
      double angle = dlon + 0.5 * turn;
      V g = change_by_turn((V){angle * cl, -dlat, -angle * sl}, (V){gn, 0.0, gd});
      gn += g.x, ge = g.y, gd += g.z;

      u.x += gn * t, u.y += ge * t, u.z += gd * t;
      double w = t * t;
      double dn = vn * t + d.x + w * (0.5 * gn - (gn - gn0) / 6.0), de = vi * t + d.y + w * (0.5 * ge - ge / 6.0);
      double dd = vd * t + d.z + w * (0.5 * gd - (gd - gd0) / 6.0);
      double sw = turn - turn * turn * turn / 6.0, cw = 0.5 * turn * turn;
      double kx = sl * de, ky = axis - sl * dn - cl * dd, kz = cl * de;
      double rn = dn - sw * kx, re = de - sw * ky, rd = dd - sw * kz;
      rn += cw * sl * ky;
      re -= cw * de;
      rd += cw * cl * ky;

      double out = -sl * rn - cl * rd, radius = axis + out;
      dlon = re / radius;
      dlon -= dlon * dlon * dlon / 3.0;
      double bulge = 0.5 * re * re / radius, up = cl * bulge - rd, north = rn - sl * bulge;
      dlat = north / (meridian + height);
      double h = 0.5 * dlat;
      sm = sl + h * (cl - 0.5 * h * sl), cm = cl - h * (sl + 0.5 * h * cl);
      radii(sm, &meridian, &unused);
      double chord = north - h * (up + 0.5 * h * north), rise = up + h * (north - 0.5 * h * up);
      dlat = chord / (meridian + height + 0.5 * rise);
      lat_low += dlat;
      carry(&lat, &lat_low);
      lon_low += dlon;
      carry(&lon, &lon_low);
      if (lon > PI) lon -= 2.0 * PI;
      else if (lon < -PI) lon += 2.0 * PI;
      height += rise;

      angle = dlon + turn;
      double zx = angle * cm, zy = -dlat, zz = -angle * sm;
      V p = change_by_turn((V){-zx, -zy, -zz}, (V){vn + u.x, vi + u.y, vd + u.z});
      vn += u.x + p.x, ve += u.y + p.y - RATE * (out + bulge), vd += u.z + p.z;
      Q s4 = {q.w * dq.w - q.x * dq.x - q.y * dq.y - q.z * dq.z, q.w * dq.x + q.x * dq.w + q.y * dq.z - q.z * dq.y,
              q.w * dq.y - q.x * dq.z + q.y * dq.w + q.z * dq.x, q.w * dq.z + q.x * dq.y - q.y * dq.x + q.z * dq.w};
      Q l = turn_of(-zx, -zy, -zz);
      Q m = {q.w + s4.w, q.x + s4.x, q.y + s4.y, q.z + s4.z};
      double lack = 0.5 - 0.5 * (q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
      low.w += s4.w + (l.w * m.w - l.x * m.x - l.y * m.y - l.z * m.z) + lack * q.w;
      low.x += s4.x + (l.w * m.x + l.x * m.w + l.y * m.z - l.z * m.y) + lack * q.x;
      low.y += s4.y + (l.w * m.y - l.x * m.z + l.y * m.w + l.z * m.x) + lack * q.y;
      low.z += s4.z + (l.w * m.z + l.x * m.y - l.y * m.x + l.z * m.w) + lack * q.z;
      carry(&q.w, &low.w);
      carry(&q.x, &low.x);
      carry(&q.y, &low.y);
      carry(&q.z, &low.z);
    }
    position[3 * k] = lat, position[3 * k + 1] = lon, position[3 * k + 2] = height;
    velocity[3 * k] = vn, velocity[3 * k + 1] = ve, velocity[3 * k + 2] = vd;
    attitude[4 * k] = q.w, attitude[4 * k + 1] = q.x, attitude[4 * k + 2] = q.y, attitude[4 * k + 3] = q.z;
  }
  double end[16] = {lat, lon, height, vn, ve, vd, q.w, q.x, q.y, q.z, lat_low, lon_low, low.w, low.x, low.y, low.z};
  for (int j = 0; j < 16; j++) state[j] = end[j];
  double last[7] = {t0, p0.x, p0.y, p0.z, u0.x, u0.y, u0.z};
  for (int j = 0; j < 7; j++) memory[j] = last[j];
  return done;
}
