/* The step of beam.c as one writes it first: loops over elements and nodes, a block of 3 x 3 numbers for each, and the
   elimination of a block tridiagonal matrix from the first node to the last (Thomas). The same arguments as there. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    double diagonal[3][3], upper[3][3], lower[3][3], r[3];
} Row;

/* r = M w - load - Q(q), and A = M - slope dQ/dq */
static void assemble(const double *numbers, double slope, long nodes, const double *mass, const double *load,
                     const double *q, const double *w, Row *rows) {
    double length = numbers[0], EA = numbers[1], GA = numbers[2], EI = numbers[3];
    memset(rows, 0, nodes * sizeof(Row));
    for (long i = 0; i < nodes; i++)
        for (int k = 0; k < 3; k++) {
            rows[i].diagonal[k][k] = mass[k * nodes + i];
            rows[i].r[k] = mass[k * nodes + i] * w[k * nodes + i] - load[k * nodes + i];
        }
    for (long e = 0; e + 1 < nodes; e++) {
        const double *x = q + e, *y = q + nodes + e, *theta = q + 2 * nodes + e;
        double angle = (theta[0] + theta[1]) / 2, c = cos(angle), s = sin(angle);
        double dx = (x[1] - x[0]) / length, dy = (y[1] - y[0]) / length, turn = (theta[1] - theta[0]) / length;
        double stretched = c * dx + s * dy, shear = c * dy - s * dx, strain[3] = {stretched - 1, shear, turn};
        double stiffness[3] = {EA, GA, EI};
        /* derivatives of the three strains by x, y, theta of both nodes */
        double B[3][6] = {{-c / length, -s / length, shear / 2, c / length, s / length, shear / 2},
                          {s / length, -c / length, -stretched / 2, -s / length, c / length, -stretched / 2},
                          {0, 0, -1 / length, 0, 0, 1 / length}};
        double force[3], K[6][6], f[6];
        for (int k = 0; k < 3; k++) force[k] = length * stiffness[k] * strain[k];
        for (int i = 0; i < 6; i++) {
            f[i] = 0;
            for (int k = 0; k < 3; k++) f[i] += B[k][i] * force[k];
            for (int j = 0; j < 6; j++) {
                K[i][j] = 0;
                for (int k = 0; k < 3; k++) K[i][j] += length * B[k][i] * stiffness[k] * B[k][j];
            }
        }
        /* of the strains' second derivatives: d2 stretched = shear/2 by theta, and so on */
        double a = (force[0] * s + force[1] * c) / (2 * length), b = (force[1] * s - force[0] * c) / (2 * length);
        double second = -(force[0] * stretched + force[1] * shear) / 4;
        for (int i = 2; i < 6; i += 3) {
            K[0][i] += a, K[i][0] += a, K[3][i] -= a, K[i][3] -= a;
            K[1][i] += b, K[i][1] += b, K[4][i] -= b, K[i][4] -= b;
            for (int j = 2; j < 6; j += 3) K[i][j] += second;
        }
        for (int i = 0; i < 3; i++) {
            rows[e].r[i] += f[i], rows[e + 1].r[i] += f[i + 3];
            for (int j = 0; j < 3; j++) {
                rows[e].diagonal[i][j] += slope * K[i][j], rows[e].upper[i][j] = slope * K[i][j + 3];
                rows[e + 1].lower[i][j] = slope * K[i + 3][j], rows[e + 1].diagonal[i][j] += slope * K[i + 3][j + 3];
            }
        }
    }
}

/* [upper, r] of a row becomes diagonal^-1 [upper, r], by Gauss; symmetric and positive: without exchanges */
static void divide(Row *row) {
    for (int k = 0; k < 3; k++) {
        double over = 1 / row->diagonal[k][k];
        for (int j = 0; j < 3; j++) row->diagonal[k][j] *= over, row->upper[k][j] *= over;
        row->r[k] *= over;
        for (int i = 0; i < 3; i++) {
            if (i == k) continue;
            double factor = row->diagonal[i][k];
            for (int j = 0; j < 3; j++) {
                row->diagonal[i][j] -= factor * row->diagonal[k][j];
                row->upper[i][j] -= factor * row->upper[k][j];
            }
            row->r[i] -= factor * row->r[k];
        }
    }
}

/* r becomes A^-1 r */
static void solve(long nodes, Row *rows) {
    divide(&rows[0]);
    for (long n = 1; n < nodes; n++) {
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 3; k++) {
                rows[n].r[i] -= rows[n].lower[i][k] * rows[n - 1].r[k];
                for (int j = 0; j < 3; j++) rows[n].diagonal[i][j] -= rows[n].lower[i][k] * rows[n - 1].upper[k][j];
            }
        divide(&rows[n]);
    }
    for (long n = nodes - 2; n >= 0; n--)
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 3; k++) rows[n].r[i] -= rows[n].upper[i][k] * rows[n + 1].r[k];
}

void begin(const double *numbers, const double *mass, const double *load, long nodes, double *state) {
    Row *rows = malloc(nodes * sizeof(Row));
    double *q = state, *w = state + 6 * nodes, *a = state + 9 * nodes;
    memset(w, 0, 3 * nodes * sizeof(double));
    assemble(numbers, 0, nodes, mass, load, q, w, rows);
    for (long i = 0; i < nodes; i++)
        for (int k = 0; k < 3; k++) {
            double m = mass[k * nodes + i];
            w[k * nodes + i] = a[k * nodes + i] = m > 1e29 ? 0 : -rows[i].r[k] / m;
        }
    free(rows);
}

void run(const double *numbers, const double *mass, const double *load, const double *hub, long nodes, double h,
         double alpha, long steps, double *state) {
    double beta = (1 - alpha) * (1 - alpha) / 4, gamma = 0.5 - alpha, weight = 1 + alpha;
    double *q = state, *v = state + 3 * nodes, *w = state + 6 * nodes, *a = state + 9 * nodes;
    Row *rows = malloc(nodes * sizeof(Row));
    for (long n = 0; n < steps; n++) {
        for (long i = 0; i < 3 * nodes; i++) {
            q[i] += h * v[i] + h * h * ((0.5 - beta) * a[i] + beta * w[i]);
            v[i] += h * ((1 - gamma) * a[i] + gamma * w[i]);
        }
        if (hub) q[2 * nodes] = hub[n];
        assemble(numbers, weight * h * h * beta, nodes, mass, load, q, w, rows);
        solve(nodes, rows);
        for (int k = 0; k < 3; k++)
            for (long i = 0; i < nodes; i++) {
                long place = k * nodes + i;
                double d = -rows[i].r[k];
                q[place] += weight * h * h * beta * d, v[place] += weight * h * gamma * d;
                a[place] = w[place] + weight * d, w[place] += d;
            }
    }
    free(rows);
}
