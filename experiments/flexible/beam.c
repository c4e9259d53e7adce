/* The non-iterative HHT-alpha step of a planar exact beam, by hand: what the library's generic one is measured against.

   The same arithmetic as hhtjax.hht(alpha, linearize="predictor", start="simple") on the beam of native_beam.py: one
   Newton step on r(w) = M w - Q(q1) from w1 = w, with the analytic tangent. Two-node elements of Reissner's beam, strains
   in the middle, lumped masses. The tangent is symmetric and block tridiagonal: it is eliminated from both ends towards
   the middle, the two directions as the two halves of a vector, without pivots.

   numbers  of an element: length, EA, GA, EI
   mass, load, state: rows of `nodes` numbers, for x, y, theta; state has q, v, w, a: 12 rows. nodes is odd. What is held
   has a mass of 1e30, w = 0 and no load.
   hub      theta of the first node after every step, or null */

#include <math.h>
#include <stdlib.h>

#define INLINE static inline __attribute__((always_inline))

typedef double Pair __attribute__((vector_size(16))); /* of the direction from the first node, and of the other */
typedef struct {
    Pair xx, xy, yy, xt, yt, tt;
} Symmetric;
typedef struct {
    Pair x, y, t;
} Vector;
typedef struct {
    Vector column_x, column_y, column_t, z; /* A^-1 U and A^-1 r of a node, once those before it are eliminated */
} Eliminated;
typedef struct {
    double *xx, *xy, *yy, *xt, *yt, *plus, *minus; /* tangents of the elements, times the slope of q1 in w1 */
    double *n_x, *n_y, *turn, *bend;               /* their forces and moments */
    Eliminated *nodes;
} Work;

static Work allocate(long nodes) {
    double *p = aligned_alloc(64, 11 * sizeof(double) * ((nodes + 7) / 8 * 8));
    double *row[11];
    for (int i = 0; i < 11; i++) row[i] = p + i * ((nodes + 7) / 8 * 8);
    Eliminated *e = aligned_alloc(64, sizeof(Eliminated) * (nodes / 2 + 1));
    return (Work){row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8], row[9], row[10], e};
}

static void release(Work work) {
    free(work.xx);
    free(work.nodes);
}

/* forces and tangents of all elements; a loop for the compiler to vectorise, sines and cosines too */
static void elements(const double *numbers, double slope, long count, const double *restrict q, Work work) {
    double length = numbers[0], EA = numbers[1], GA = numbers[2], EI = numbers[3], over = 1 / length;
    double straight = slope * over, mixed = slope / 2, bending = slope * EI * over, quarter = slope * length / 4;
    const double *x = q, *y = q + count + 1, *theta = q + 2 * (count + 1);
    double *restrict xx = work.xx, *restrict xy = work.xy, *restrict yy = work.yy, *restrict xt = work.xt;
    double *restrict yt = work.yt, *restrict plus = work.plus, *restrict minus = work.minus;
    double *restrict n_x = work.n_x, *restrict n_y = work.n_y, *restrict turn = work.turn, *restrict bend = work.bend;
    /* n_x and n_y hold cosine and sine first: in one loop they would be calls of sincos, which is no vector function */
    for (long e = 0; e < count; e++) n_x[e] = cos((theta[e] + theta[e + 1]) / 2);
    for (long e = 0; e < count; e++) n_y[e] = sin((theta[e] + theta[e + 1]) / 2);
    for (long e = 0; e < count; e++) {
        double c = n_x[e], s = n_y[e], dx = (x[e + 1] - x[e]) * over, dy = (y[e + 1] - y[e]) * over;
        double stretched = c * dx + s * dy, shear = c * dy - s * dx;
        double N = EA * (stretched - 1), V = GA * shear;
        double a = EA * shear - V, b = N - GA * stretched;
        n_x[e] = c * N - s * V, n_y[e] = s * N + c * V;
        turn[e] = (N * shear - V * stretched) * length / 2;
        bend[e] = EI * over * (theta[e + 1] - theta[e]);
        xx[e] = straight * (EA * c * c + GA * s * s), yy[e] = straight * (EA * s * s + GA * c * c);
        xy[e] = straight * (EA - GA) * c * s;
        xt[e] = mixed * (c * a - s * b), yt[e] = mixed * (s * a + c * b);
        double tt = quarter * (shear * a - stretched * b);
        plus[e] = tt + bending, minus[e] = tt - bending;
    }
}

INLINE Vector solve(const Symmetric *inverse, Vector r) {
    return (Vector){inverse->xx * r.x + inverse->xy * r.y + inverse->xt * r.t,
                    inverse->xy * r.x + inverse->yy * r.y + inverse->yt * r.t,
                    inverse->xt * r.x + inverse->yt * r.y + inverse->tt * r.t};
}

INLINE Symmetric invert(const Symmetric *A) {
    Pair xx = A->yy * A->tt - A->yt * A->yt, xy = A->xt * A->yt - A->xy * A->tt, xt = A->xy * A->yt - A->xt * A->yy;
    Pair over = 1 / (A->xx * xx + A->xy * xy + A->xt * xt);
    return (Symmetric){over * xx, over * xy, over * (A->xx * A->tt - A->xt * A->xt),
                       over * xt, over * (A->xy * A->xt - A->xx * A->yt), over * (A->xx * A->yy - A->xy * A->xy)};
}

/* d = -A^-1 r for all nodes; mass, load, w, d: rows x, y, theta */
static void solve_all(long nodes, const double *mass, const double *load, const double *w, double *restrict d,
                      Work work) {
    long half = nodes / 2, last = nodes - 1;
    Symmetric C = {0}; /* what the nodes before leave to the next one, in A and in r */
    Vector carried = {0};
#define BOTH(row, i) ((Pair){(row)[i], (row)[last - (i)]})
#define EVEN(row, i) ((Pair){(row)[i], (row)[last - 1 - (i)]})
#define ODD(row, i) ((Pair){(row)[i], -(row)[last - 1 - (i)]}) /* changes its sign with the direction */
    for (long i = 0; i < half; i++) {
        Pair xx = EVEN(work.xx, i), xy = EVEN(work.xy, i), yy = EVEN(work.yy, i), xt = ODD(work.xt, i);
        Pair yt = ODD(work.yt, i), plus = EVEN(work.plus, i), minus = EVEN(work.minus, i), n_x = ODD(work.n_x, i);
        Pair n_y = ODD(work.n_y, i), turn = EVEN(work.turn, i), bend = ODD(work.bend, i);
        Pair m_x = BOTH(mass, i), m_y = BOTH(mass + nodes, i), m_t = BOTH(mass + 2 * nodes, i);
        Symmetric A = {m_x + xx + C.xx, xy + C.xy, m_y + yy + C.yy, C.xt - xt, C.yt - yt, m_t + plus + C.tt};
        Vector r = {m_x * BOTH(w, i) - BOTH(load, i) - n_x + carried.x,
                    m_y * BOTH(w + nodes, i) - BOTH(load + nodes, i) - n_y + carried.y,
                    m_t * BOTH(w + 2 * nodes, i) - BOTH(load + 2 * nodes, i) + turn - bend + carried.t};
        Symmetric inverse = invert(&A);
        Eliminated e = {solve(&inverse, (Vector){-xx, -xy, xt}), solve(&inverse, (Vector){-xy, -yy, yt}),
                        solve(&inverse, (Vector){-xt, -yt, minus}), solve(&inverse, r)};
        Vector X = e.column_x, Y = e.column_y, T = e.column_t, z = e.z;
        C = (Symmetric){xx + xx * X.x + xy * X.y - xt * X.t, xy + xx * Y.x + xy * Y.y - xt * Y.t,
                        yy + xy * Y.x + yy * Y.y - yt * Y.t, xt + xx * T.x + xy * T.y - xt * T.t,
                        yt + xy * T.x + yy * T.y - yt * T.t, plus + xt * T.x + yt * T.y - minus * T.t};
        carried = (Vector){n_x + xx * z.x + xy * z.y - xt * z.t, n_y + xy * z.x + yy * z.y - yt * z.t,
                           turn + bend + xt * z.x + yt * z.y - minus * z.t};
        work.nodes[i] = e;
    }
#define SUM(pair) ((Pair){(pair)[0] + (pair)[1], (pair)[0] + (pair)[1]})
#define AT(row, i) ((Pair){(row)[i], (row)[i]})
    Pair m_x = AT(mass, half), m_y = AT(mass + nodes, half), m_t = AT(mass + 2 * nodes, half);
    Symmetric A = {m_x + SUM(C.xx), SUM(C.xy), m_y + SUM(C.yy), SUM(C.xt), SUM(C.yt), m_t + SUM(C.tt)};
    Vector r = {m_x * AT(w, half) - AT(load, half) + SUM(carried.x),
                m_y * AT(w + nodes, half) - AT(load + nodes, half) + SUM(carried.y),
                m_t * AT(w + 2 * nodes, half) - AT(load + 2 * nodes, half) + SUM(carried.t)};
    Symmetric inverse = invert(&A);
    Vector next = solve(&inverse, (Vector){-r.x, -r.y, -r.t});
    d[half] = next.x[0], d[nodes + half] = next.y[0], d[2 * nodes + half] = next.t[0];
    for (long i = half - 1; i >= 0; i--) {
        Eliminated e = work.nodes[i];
        next = (Vector){-e.z.x - e.column_x.x * next.x - e.column_y.x * next.y - e.column_t.x * next.t,
                        -e.z.y - e.column_x.y * next.x - e.column_y.y * next.y - e.column_t.y * next.t,
                        -e.z.t - e.column_x.t * next.x - e.column_y.t * next.y - e.column_t.t * next.t};
        d[i] = next.x[0], d[nodes + i] = next.y[0], d[2 * nodes + i] = next.t[0];
        d[last - i] = next.x[1], d[nodes + last - i] = next.y[1], d[2 * nodes + last - i] = next.t[1];
    }
}

/* w = a = M^-1 Q */
void begin(const double *numbers, const double *mass, const double *load, long nodes, double *state) {
    Work work = allocate(nodes);
    double *q = state, *w = state + 6 * nodes, *a = state + 9 * nodes;
    for (long i = 0; i < 3 * nodes; i++) w[i] = 0;
    elements(numbers, 0, nodes - 1, q, work); /* with no slope A is M */
    solve_all(nodes, mass, load, w, a, work);
    for (long i = 0; i < 3 * nodes; i++) w[i] = a[i] = mass[i] > 1e29 ? 0 : a[i];
    release(work);
}

void run(const double *numbers, const double *mass, const double *load, const double *hub, long nodes, double h,
         double alpha, long steps, double *state) {
    double beta = (1 - alpha) * (1 - alpha) / 4, gamma = 0.5 - alpha, weight = 1 + alpha;
    double q_a = h * h * (0.5 - beta), q_w = h * h * beta, v_a = h * (1 - gamma), v_w = h * gamma;
    double *restrict q = state, *restrict v = state + 3 * nodes, *restrict w = state + 6 * nodes;
    double *restrict a = state + 9 * nodes, *restrict d = malloc(3 * nodes * sizeof(double));
    Work work = allocate(nodes);
    for (long n = 0; n < steps; n++) {
        for (long i = 0; i < 3 * nodes; i++) {
            q[i] += h * v[i] + q_a * a[i] + q_w * w[i];
            v[i] += v_a * a[i] + v_w * w[i];
        }
        if (hub) q[2 * nodes] = hub[n];
        elements(numbers, weight * q_w, nodes - 1, q, work);
        solve_all(nodes, mass, load, w, d, work);
        for (long i = 0; i < 3 * nodes; i++) {
            q[i] += weight * q_w * d[i], v[i] += weight * v_w * d[i];
            a[i] = w[i] + weight * d[i], w[i] += d[i];
        }
    }
    release(work);
    free(d);
}
