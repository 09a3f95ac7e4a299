// Weighted sums of integrals of Legendre polynomials over spherical polygons,
//   out[p] = sum_{l=1..L, k} w[l][k] I_l(d_k),   I_l(d) = integral over polygon p of P_l(omega . d),
// in float32 on one thread: one polygon per lane, axes in turn, all edges of a polygon at a time.
//
// An edge a -> b of length theta has n = a x b / |a x b|, t = n x a, g = n.d, u0 = a.d, u1 = b.d and the derivatives
// u0' = t.d, u1' = -u0 sin theta + u0' cos theta. With E_l and D_l the integrals of P_l and P_l' along it,
//   I_l = 1/(l (l+1)) sum_edges g D_l,   D_l = D_{l-2} + (2l-1) E_{l-1},
//   E_l = ((l-1)/l)^2 E_{l-2} - (2l-1)/l^2 (u1' P_{l-1}(u1) - u0' P_{l-1}(u0) + g^2 D_{l-1}).
// polygon_moments does that, the recurrences of Wang and Ramamoorthi 2018. polygon_moments_difference integrates
// P_l - P_l(u_c) instead, u_c at the first vertex, which keeps its digits in small polygons, and adds P_l(u_c) back.

#include <cmath>
#include <vector>

#ifndef LANES
#define LANES 8
#endif

namespace {

typedef float V __attribute__((vector_size(4 * LANES)));
typedef int Mask __attribute__((vector_size(4 * LANES)));

const V zero = {}, one = zero + 1, tiny = zero + 1e-30f;

inline V larger(V a, V b) { return a > b ? a : b; }

inline V root(V x) {
  V y;
  for (int i = 0; i < LANES; ++i) y[i] = std::sqrt(x[i]);
  return y;
}

// atan(t)/t - 1 of z = t^2 <= tan^2(pi/8): minimax to 3e-9
inline V atan_excess(V z) {
  return z * (-0.333333319f + z * (0.199995579f + z * (-0.142644505f + z * (0.107482387f - z * 0.0646476249f))));
}

// atan2(y, x) for y >= 0
inline V angle(V y, V x) {
  V ax = larger(x, -x);
  Mask steep = y > ax;
  V low = steep ? ax : y, high = steep ? y : ax;
  Mask large = low > 0.414213562f * high;
  V q = (large ? low - high : low) / larger(large ? low + high : high, tiny);
  V t = q + q * atan_excess(q * q) + (large ? zero + 0.785398163f : zero);
  t = steep ? 1.57079633f - t : t;
  return x < 0 ? 3.14159265f - t : t;
}

struct V3 {
  V x, y, z;
};
struct Axis {
  float x, y, z;
};
inline V3 operator+(V3 a, V3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline V3 operator-(V3 a, V3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline V3 operator*(V s, V3 a) { return {s * a.x, s * a.y, s * a.z}; }
template <class A, class B> inline V dot(A a, B b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline V3 cross(V3 a, V3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline V3 select(Mask m, V3 a, V3 b) { return {m ? a.x : b.x, m ? a.y : b.y, m ? a.z : b.z}; }

struct Coefficients {
  float a, b, c, k, k_;  // ((l-1)/l)^2, (2l-1)/l^2, 2l-1, (2l-1)/l, (l-1)/l
};

struct Problem {
  int axes, degree;
  const float* d;
  std::vector<Coefficients> c;
  std::vector<float> w;  // [K][L+1], divided by l (l+1)
};

template <int N> struct Slot {
  static constexpr int now = N, last = 1 - N;  // `now` holds degree l-2 and receives l, `last` holds l-1
};

template <class Step, class Last> inline V recur(int degree, Step step, Last last) {
  int l = 2;
  for (; l + 1 < degree; l += 2) {
    step(l, Slot<0>());
    step(l + 1, Slot<1>());
  }
  if (l >= degree) return last(Slot<0>());
  step(l, Slot<0>());
  return last(Slot<1>());
}

#define EDGES _Pragma("GCC unroll 8") for (int i = 0; i < S; ++i)

template <int S> struct Plain {
  V3 a[S], n[S], t[S];
  V theta[S], sine[S], cosine[S];

  explicit Plain(const V3* vertices) {
    EDGES {
      const int j = (i + 1) % S;
      a[i] = vertices[i];
      V3 m = cross(a[i], vertices[j] - a[i]);
      sine[i] = root(dot(m, m));
      cosine[i] = dot(a[i], vertices[j]);
      theta[i] = angle(sine[i], cosine[i]);
      n[i] = (1 / larger(sine[i], tiny)) * m;
      t[i] = cross(n[i], a[i]);
    }
  }

  V sum(const Problem& problem, Axis d, const float* w) const {
    V u[S], du0[S], du1[S], g[S], g2[S], P[2][S], E[2][S], D[2][S], total[S];
    EDGES {
      u[i] = dot(a[i], d);
      g[i] = dot(n[i], d);
      g2[i] = g[i] * g[i];
      du0[i] = dot(t[i], d);
      du1[i] = du0[i] * cosine[i] - u[i] * sine[i];
      P[0][i] = one, P[1][i] = u[i];
      E[0][i] = theta[i], E[1][i] = du0[i] - du1[i];
      D[0][i] = zero, D[1][i] = theta[i];
      total[i] = w[1] * theta[i];
    }
    auto step = [&](int l, auto s) {
      const Coefficients c = problem.c[l];
      EDGES {
        const int j = (i + 1) % S;
        V F = du1[i] * P[s.last][j] - du0[i] * P[s.last][i] + g2[i] * D[s.last][i];
        E[s.now][i] = c.a * E[s.now][i] - c.b * F;
        D[s.now][i] += c.c * E[s.last][i];
        total[i] += w[l] * D[s.now][i];
      }
      EDGES P[s.now][i] = c.k * (u[i] * P[s.last][i]) - c.k_ * P[s.now][i];
    };
    auto last = [&](auto s) {
      const int l = problem.degree;
      V sum = zero;
      EDGES {
        if (l > 1) total[i] += w[l] * (D[s.now][i] + problem.c[l].c * E[s.last][i]);
        sum += g[i] * total[i];
      }
      return sum;
    };
    return recur(problem.degree, step, last);
  }
};

// c: first vertex. A vertex is c + tau - kappa c with tau orthogonal to c; an edge is e = b - a; x = tan^2(theta/2).
template <int S> struct Difference {
  V3 c, tau[S], dtau[S], g[S], T;
  V kappa[S], dkappa[S], inverse_theta[S], tangent[S], r1[S], half[S], half_excess[S], slope[S], shift[S];
  Mask short_edge[S];

  explicit Difference(const V3* vertices) : c(vertices[0]), T{} {
    V3 alpha[S];
    EDGES {
      V3 v = vertices[i], difference = v - c;
      tau[i] = difference - dot(difference, c) * c;
      V sine2 = dot(tau[i], tau[i]), cosine = dot(v, c);
      kappa[i] = cosine > 0.5f ? sine2 / (1 + root(larger(1 - sine2, zero))) : 1 - cosine;
      alpha[i] = tau[i] - kappa[i] * c;
    }
    EDGES {
      const int j = (i + 1) % S;
      V3 v = vertices[i], sum = v + vertices[j];
      dtau[i] = tau[j] - tau[i];
      dkappa[i] = kappa[j] - kappa[i];
      V3 e = dtau[i] - dkappa[i] * c;
      V x = dot(e, e) / dot(sum, sum), t = root(x);
      V A = x < 0.17157f ? atan_excess(x) : angle(t, one) / larger(t, tiny) - 1;  // atan(t)/t - 1
      V theta = 2 * t * (1 + A), inverse_sine = (1 + x) / larger(2 * t, tiny);
      r1[i] = x + A * (1 + x);
      V r = (1 + x) * (1 + A);  // theta / sin(theta) = 1 + r1
      short_edge[i] = x < 1;
      g[i] = r * cross(v, select(short_edge[i], e, sum));
      T = T + r1[i] * cross(c, e) + r * cross(alpha[i], e);
      inverse_theta[i] = 1 / larger(theta, tiny);
      tangent[i] = t;
      half[i] = 0.5f / (1 + A);
      half_excess[i] = A * half[i];
      slope[i] = short_edge[i] ? inverse_sine : -inverse_sine;
      shift[i] = short_edge[i] ? -t : 1 / larger(t, tiny);
    }
  }

  V sum(const Problem& problem, Axis axis, const float* w) const {
    V uc = dot(c, axis);
    const V sign = uc < 0 ? -one : one;
    const V3 eps = {axis.x - sign * c.x, axis.y - sign * c.y, axis.z - sign * c.z};
    const V versine = 0.5f * dot(eps, eps);
    uc = sign * (1 - versine);
    V y[S], u[S], h[S], G[S], g2[S], du1[S], k1[S], k2[S], e1[S], q[2][S], d[2][S], E[2][S], D[2][S], total[S];
    EDGES {
      y[i] = dot(tau[i], eps) - kappa[i] * uc;
      u[i] = uc + y[i];
    }
    EDGES {
      const int j = (i + 1) % S;
      V along = dot(dtau[i], eps) - dkappa[i] * uc, both = u[i] + u[j];
      h[i] = along * inverse_theta[i];
      G[i] = dot(g[i], axis);
      g2[i] = G[i] * inverse_theta[i];
      g2[i] *= g2[i];
      du1[i] = (short_edge[i] ? along : both) * slope[i] + u[j] * shift[i];
      k1[i] = du1[i] * (u[j] * tangent[i] - h[i] * r1[i]) - y[j] * (u[j] + uc);
      k2[i] = both * half_excess[i] - 0.5f * (y[i] + y[j]);
      e1[i] = both * half[i];
      q[0][i] = zero, q[1][i] = y[i];
      d[0][i] = zero, d[1][i] = zero;
      E[0][i] = zero, E[1][i] = -k2[i];
      D[0][i] = zero, D[1][i] = zero;
      total[i] = zero;
    }
    const V TT = dot(T, axis);
    V step_P = -versine, P_abs = 1 - versine, parity = sign;  // P_l(|uc|) - P_{l-1}(|uc|), P_l(|uc|), sign^l
    V P = uc, dP[2] = {zero, one}, reference = w[1] * one;
    auto step = [&](int l, auto s) {
      const Coefficients k = problem.c[l];
      EDGES {
        const int j = (i + 1) % S;
        V F = du1[i] * d[s.last][i] - e1[i] * q[s.last][i] + g2[i] * D[s.last][i] + P * k2[i] + dP[s.last] * k1[i];
        E[s.now][i] = k.a * E[s.now][i] - k.b * F;
        D[s.now][i] += k.c * E[s.last][i];
        total[i] += w[l] * D[s.now][i];
        V inner = u[j] * d[s.last][i] + h[i] * (q[s.last][i] + y[j] * dP[s.last]);
        d[s.now][i] = k.k * inner - k.k_ * d[s.now][i];
      }
      EDGES q[s.now][i] = k.k * (u[i] * q[s.last][i] + y[i] * P) - k.k_ * q[s.now][i];
      step_P = k.k_ * step_P - k.k * (versine * P_abs);
      P_abs += step_P;
      parity *= sign;
      dP[s.now] += k.c * P;
      reference += w[l] * dP[s.now];
      P = parity * P_abs;
    };
    auto last = [&](auto s) {
      const int l = problem.degree;
      if (l > 1) {
        const float k = problem.c[l].c;
        reference += w[l] * (dP[s.now] + k * P);
        EDGES total[i] += w[l] * (D[s.now][i] + k * E[s.last][i]);
      }
      V sum = TT * reference;
      EDGES sum += G[i] * total[i];
      return sum;
    };
    return recur(problem.degree, step, last);
  }
};

template <class Form, int S> void run(const float* v, const Problem& problem, float* out, int polygons) {
  for (int start = 0; start < polygons; start += LANES) {
    const int count = polygons - start < LANES ? polygons - start : LANES;
    V3 vertices[S] = {};
    for (int lane = 0; lane < LANES; ++lane) {
      const float* p = v + 3 * S * (start + (lane < count ? lane : 0));
      for (int i = 0; i < S; ++i) {
        vertices[i].x[lane] = p[3 * i];
        vertices[i].y[lane] = p[3 * i + 1];
        vertices[i].z[lane] = p[3 * i + 2];
      }
    }
    const Form form(vertices);
    V total = zero;
    for (int k = 0; k < problem.axes; ++k) {
      const float* d = problem.d + 3 * k;
      total += form.sum(problem, {d[0], d[1], d[2]}, &problem.w[k * (problem.degree + 1)]);
    }
    for (int lane = 0; lane < count; ++lane) out[start + lane] = total[lane];
  }
}

template <template <int> class Form>
int dispatch(const float* v, const float* d, const float* w, float* out, int polygons, int sides, int axes,
             int degree) {
  if (degree < 1) return 1;
  Problem problem{axes, degree, d, std::vector<Coefficients>(degree + 1), std::vector<float>(axes * (degree + 1))};
  for (int l = 1; l <= degree; ++l) {
    const double n = l;
    problem.c[l] = {float((n - 1) * (n - 1) / (n * n)), float((2 * n - 1) / (n * n)), float(2 * n - 1),
                    float((2 * n - 1) / n), float((n - 1) / n)};
    for (int k = 0; k < axes; ++k) problem.w[k * (degree + 1) + l] = float(w[l * axes + k] / (n * (n + 1)));
  }
  switch (sides) {
    case 3: run<Form<3>, 3>(v, problem, out, polygons); return 0;
    case 4: run<Form<4>, 4>(v, problem, out, polygons); return 0;
    case 5: run<Form<5>, 5>(v, problem, out, polygons); return 0;
    case 6: run<Form<6>, 6>(v, problem, out, polygons); return 0;
    case 8: run<Form<8>, 8>(v, problem, out, polygons); return 0;
    default: return 2;
  }
}

}  // namespace

// v [P, S, 3], d [K, 3], w [L+1, K], out [P]; 0 when done, 1 for L < 1, 2 for S other than 3, 4, 5, 6, 8
extern "C" int polygon_moments(const float* v, const float* d, const float* w, float* out, int P, int S, int K, int L) {
  return dispatch<Plain>(v, d, w, out, P, S, K, L);
}

extern "C" int polygon_moments_difference(const float* v, const float* d, const float* w, float* out, int P, int S,
                                          int K, int L) {
  return dispatch<Difference>(v, d, w, out, P, S, K, L);
}
