/* The non-iterative HHT-alpha step of the double pendulum, by hand: what the library's generic one is measured against.

   The same arithmetic as hhtjax.hht(alpha, linearize="predictor") on hhtjax.scenes.double_pendulum: one Newton step on
   r(w) = M(q1) w - Q(q1, v1) from w1 = w, with the analytic Jacobian and Cramer's rule.

   p    m1 m2 l1 l2 k1 k2 c1 c2 g reaction; reaction is 1 for the torques of both joints, 0 as Kim et al. printed them
   y    q1 q2 v1 v2 w1 w2 a1 a2, in and out; of a batch 8 rows of `members` numbers */

#include <math.h>

#define BLOCK 64 /* members that are stepped together: 4 kB of state */
#define INLINE static inline __attribute__((always_inline))

typedef struct {
    double M11, M22, coupling, G1, G2, k1, k2, c1, c2, r; /* of the system */
    double h, q_a, q_w, v_a, v_w, a_w;                    /* of the method */
} Constants;

static Constants constants(const double *p, double h, double alpha) {
    double m1 = p[0], m2 = p[1], l1 = p[2], l2 = p[3], g = p[8];
    double beta = (1 - alpha) * (1 - alpha) / 4, gamma = 0.5 - alpha;
    return (Constants){l1 * l1 * (m1 + m2), l2 * l2 * m2, l1 * l2 * m2, l1 * (m1 + m2) * g, l2 * m2 * g,
                       p[4], p[5], p[6], p[7], p[9],
                       h, h * h * (0.5 - beta), h * h * beta, h * (1 - gamma), h * gamma, 1 + alpha};
}

/* M12 and Q, from q, v and the sines and cosines that they need; those of d = q1 - q2 are s and c */
#define FORCES(k, q1, q2, v1, v2, cos1, cos2, s, c)                                                         \
    double M12 = k->coupling * (c), torque2 = -k->k2 * (q2 - q1) - k->c2 * (v2 - v1);                        \
    double Q1 = -k->G1 * (cos1) - k->coupling * (s) * v2 * v2 - k->k1 * q1 - k->c1 * v1 - k->r * torque2;    \
    double Q2 = -k->G2 * (cos2) + k->coupling * (s) * v1 * v1 + torque2;

/* the step, once q, v are predicted (written over the old ones) and the sines and cosines are there */
INLINE void correct(const Constants *k, double *q1, double *q2, double *v1, double *v2, double *w1, double *w2,
                    double *a1, double *a2, double sin1, double cos1, double sin2, double cos2, double s, double c) {
    FORCES(k, *q1, *q2, *v1, *v2, cos1, cos2, s, c)
    double r1 = k->M11 * *w1 + M12 * *w2 - Q1, r2 = M12 * *w1 + k->M22 * *w2 - Q2;
    double K12 = k->coupling, x1 = K12 * c * *v1 * *v1, x2 = K12 * c * *v2 * *v2, y = K12 * s;
    double Kq = k->a_w * k->q_w, Kv = k->a_w * k->v_w;
    double A11 = k->M11 + Kq * (-y * *w2 - k->G1 * sin1 + x2 + k->k1 + k->r * k->k2) + Kv * (k->c1 + k->r * k->c2);
    double A12 = M12 + Kq * (y * *w2 - x2 - k->r * k->k2) + Kv * (2 * y * *v2 - k->r * k->c2);
    double A21 = M12 + Kq * (-y * *w1 - x1 - k->k2) - Kv * (2 * y * *v1 + k->c2);
    double A22 = k->M22 + Kq * (y * *w1 - k->G2 * sin2 + x1 + k->k2) + Kv * k->c2;
    double inverse = -1 / (A11 * A22 - A12 * A21);
    double d1 = (A22 * r1 - A12 * r2) * inverse, d2 = (A11 * r2 - A21 * r1) * inverse;
    *q1 += Kq * d1, *q2 += Kq * d2, *v1 += Kv * d1, *v2 += Kv * d2;
    *a1 = *w1 + k->a_w * d1, *a2 = *w2 + k->a_w * d2;
    *w1 += d1, *w2 += d2;
}

INLINE void predict(const Constants *k, double *q, double *v, double w, double a) {
    *q += k->h * *v + k->q_a * a + k->q_w * w;
    *v += k->v_a * a + k->v_w * w;
}

INLINE void acceleration(const double *p, double q1, double q2, double v1, double v2, double *w1, double *w2) {
    Constants system = constants(p, 0, 0), *k = &system;
    FORCES(k, q1, q2, v1, v2, cos(q1), cos(q2), sin(q1 - q2), cos(q1 - q2))
    double inverse = 1 / (k->M11 * k->M22 - M12 * M12);
    *w1 = (k->M22 * Q1 - M12 * Q2) * inverse, *w2 = (k->M11 * Q2 - M12 * Q1) * inverse;
}

/* dy = (v, w) of y = (q, v): for general solvers of ordinary differential equations */
void rate(const double *p, const double *y, double *dy) {
    dy[0] = y[2], dy[1] = y[3];
    acceleration(p, y[0], y[1], y[2], y[3], &dy[2], &dy[3]);
}

/* w = a = M^-1 Q, for all members */
void begin(const double *p, double *y, long members) {
    for (long b = 0; b < members; b++) {
        double *z = y + b, *w1 = z + 4 * members, *w2 = z + 5 * members;
        acceleration(p, z[0], z[members], z[2 * members], z[3 * members], w1, w2);
        z[6 * members] = *w1, z[7 * members] = *w2;
    }
}

/* one trajectory; path: q and v after every step, 4 numbers each, or null */
void run(const double *p, double h, double alpha, long steps, double *y, double *path) {
    Constants k = constants(p, h, alpha);
    double q1 = y[0], q2 = y[1], v1 = y[2], v2 = y[3], w1 = y[4], w2 = y[5], a1 = y[6], a2 = y[7];
    for (long n = 0; n < steps; n++) {
        predict(&k, &q1, &v1, w1, a1);
        predict(&k, &q2, &v2, w2, a2);
        correct(&k, &q1, &q2, &v1, &v2, &w1, &w2, &a1, &a2, sin(q1), cos(q1), sin(q2), cos(q2), sin(q1 - q2),
                cos(q1 - q2));
        if (path) {
            path[4 * n] = q1, path[4 * n + 1] = q2, path[4 * n + 2] = v1, path[4 * n + 3] = v2;
        }
    }
    y[0] = q1, y[1] = q2, y[2] = v1, y[3] = v2, y[4] = w1, y[5] = w2, y[6] = a1, y[7] = a2;
}

/* a batch, in blocks that stay in the nearest cache; the loops over members are for the compiler to vectorise: sines
   and cosines apart, because those of one loop would become calls of sincos, which is no vector function */
void run_batch(const double *p, double h, double alpha, long steps, double *y, long members) {
    Constants k = constants(p, h, alpha);
    for (long first = 0; first < members; first += BLOCK) {
        double z[8][BLOCK] = {{0}}, x[3 * BLOCK], sine[3 * BLOCK], cosine[3 * BLOCK];
        long count = members - first < BLOCK ? members - first : BLOCK;
        for (int i = 0; i < 8; i++)
            for (long b = 0; b < count; b++) z[i][b] = y[i * members + first + b];
        for (long n = 0; n < steps; n++) {
            for (int b = 0; b < BLOCK; b++) {
                predict(&k, &z[0][b], &z[2][b], z[4][b], z[6][b]);
                predict(&k, &z[1][b], &z[3][b], z[5][b], z[7][b]);
                x[b] = z[0][b], x[BLOCK + b] = z[1][b], x[2 * BLOCK + b] = z[0][b] - z[1][b];
            }
            for (int i = 0; i < 3 * BLOCK; i++) sine[i] = sin(x[i]);
            for (int i = 0; i < 3 * BLOCK; i++) cosine[i] = cos(x[i]);
            for (int b = 0; b < BLOCK; b++)
                correct(&k, &z[0][b], &z[1][b], &z[2][b], &z[3][b], &z[4][b], &z[5][b], &z[6][b], &z[7][b], sine[b],
                        cosine[b], sine[BLOCK + b], cosine[BLOCK + b], sine[2 * BLOCK + b], cosine[2 * BLOCK + b]);
        }
        for (int i = 0; i < 8; i++)
            for (long b = 0; b < count; b++) y[i * members + first + b] = z[i][b];
    }
}
