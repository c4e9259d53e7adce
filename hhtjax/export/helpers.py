"""Functions of C99 that exported models call: elimination, singular values, and what C has not as XLA does it."""

import numpy as np

from hhtjax.export.expressions import TYPES, number

HELPERS = {
    "max": "static @ #_max(const @ a, const @ b) { return (a > b || isnan(a)) ? a : b; }",
    "min": "static @ #_min(const @ a, const @ b) { return (a < b || isnan(a)) ? a : b; }",
    "sign": "static @ #_sign(const @ a) { return a > 0 ? 1 : (a < 0 ? -1 : a); }",
    "whole": """static double #_whole(const double a, const double low, const double high)
{
    return isnan(a) ? 0 : (a < low ? low : (a > high ? high : a));
}""",
    "lu": """/* L below the diagonal and U on and above it: row i of a, its rows in the given order, is that of L U */
static void #_lu(const int n, @ *const a, int32_t *const pivots, int32_t *const order)
{
    int i, j, k;
    for (i = 0; i < n; i++) {
        order[i] = i;
    }
    for (k = 0; k < n; k++) {
        int pivot = k;
        for (i = k + 1; i < n; i++) {
            if (fabs~(a[i * n + k]) > fabs~(a[pivot * n + k])) {
                pivot = i;
            }
        }
        pivots[k] = pivot;
        if (pivot != k) {
            const int32_t row = order[k];
            order[k] = order[pivot];
            order[pivot] = row;
            for (j = 0; j < n; j++) {
                const @ x = a[k * n + j];
                a[k * n + j] = a[pivot * n + j];
                a[pivot * n + j] = x;
            }
        }
        for (i = k + 1; i < n; i++) {
            const @ factor = a[i * n + k] / a[k * n + k];
            a[i * n + k] = factor;
            for (j = k + 1; j < n; j++) {
                a[i * n + j] -= factor * a[k * n + j];
            }
        }
    }
}""",
    "triangular": """/* the x of a triangle of a, or of its transpose, in the place of its right-hand side */
static void #_triangular(const int n, const @ *const a, @ *const x, const int lower, const int transpose,
                         const int unit)
{
    int i, j;
    for (i = 0; i < n; i++) {
        const int forward = (lower != transpose);
        const int k = forward ? i : n - 1 - i;
        if (!unit) {
            x[k] /= a[k * n + k];
        }
        for (j = forward ? k + 1 : 0; j < (forward ? n : k); j++) {
            x[j] -= (transpose ? a[k * n + j] : a[j * n + k]) * x[k];
        }
    }
}""",
    "svd": """/* s, u and the transpose of v with a = u diag(s) v^T, s falling: by rotations of columns in pairs until
   they are orthogonal (Hestenes 1958), or nothing but rounding; what is not after so many sweeps is no number */
static void #_svd(const int n, const @ *const a, @ *const s, @ *const u, @ *const vt)
{
    int i, j, k, sweep, turned = 1;
    @ rounding = 0;
    for (i = 0; i < n * n; i++) {
        rounding += a[i] * a[i];
        u[i] = a[i];
        vt[i] = (i % (n + 1) == 0) ? 1 : 0;
    }
    rounding = n * $ * sqrt~(rounding);
    for (sweep = 0; sweep < 40 && turned; sweep++) {
        turned = 0;
        for (i = 0; i < n; i++) {
            for (j = i + 1; j < n; j++) {
                @ p = 0, q = 0, r = 0;
                for (k = 0; k < n; k++) {
                    p += u[k * n + i] * u[k * n + i];
                    q += u[k * n + j] * u[k * n + j];
                    r += u[k * n + i] * u[k * n + j];
                }
                p = sqrt~(p);
                q = sqrt~(q);
                if (p > rounding && q > rounding && fabs~(r) > n * $ * p * q) {
                    const @ z = (q - p) * (q + p) / (2 * r);
                    const @ t = (z < 0 ? -1 : 1) / (fabs~(z) + sqrt~(1 + z * z));
                    const @ cosine = 1 / sqrt~(1 + t * t), sine = t * cosine;
                    turned = 1;
                    for (k = 0; k < n; k++) {
                        const @ x = u[k * n + i], y = vt[i * n + k];
                        u[k * n + i] = cosine * x - sine * u[k * n + j];
                        u[k * n + j] = sine * x + cosine * u[k * n + j];
                        vt[i * n + k] = cosine * y - sine * vt[j * n + k];
                        vt[j * n + k] = sine * y + cosine * vt[j * n + k];
                    }
                }
            }
        }
    }
    for (i = 0; i < n; i++) {
        @ p = 0;
        for (k = 0; k < n; k++) {
            p += u[k * n + i] * u[k * n + i];
        }
        s[i] = turned ? (@)NAN : sqrt~(p);
    }
    for (i = 0; i < n; i++) {
        int largest = i;
        for (j = i + 1; j < n; j++) {
            if (s[j] > s[largest]) {
                largest = j;
            }
        }
        const @ size = s[largest];
        s[largest] = s[i];
        s[i] = size;
        for (k = 0; k < n; k++) {
            const @ x = u[k * n + i], y = vt[i * n + k];
            u[k * n + i] = (size <= rounding) ? 0 : u[k * n + largest] / size;
            vt[i * n + k] = vt[largest * n + k];
            if (largest != i) {
                u[k * n + largest] = x;
                vt[largest * n + k] = y;
            }
        }
    }
    for (i = 0; i < n; i++) { /* of rounding: the unit vector of which most is left beside the other columns */
        int at, again;
        for (at = 0; s[i] <= rounding && at < n; at++) {
            @ left = 1;
            for (j = 0; j < i; j++) {
                left -= u[at * n + j] * u[at * n + j];
            }
            if (2 * n * left >= 1) {
                break;
            }
        }
        for (k = 0; s[i] <= rounding && k < n; k++) {
            u[k * n + i] = (k == at) ? 1 : 0;
        }
        for (again = 0; s[i] <= rounding && again < 2; again++) {
            @ size = 0;
            for (j = 0; j < i; j++) {
                @ r = 0;
                for (k = 0; k < n; k++) {
                    r += u[k * n + j] * u[k * n + i];
                }
                for (k = 0; k < n; k++) {
                    u[k * n + i] -= r * u[k * n + j];
                }
            }
            for (k = 0; k < n; k++) {
                size += u[k * n + i] * u[k * n + i];
            }
            for (k = 0; k < n; k++) {
                u[k * n + i] /= sqrt~(size);
            }
        }
    }
}""",
}


def helper(name, prefix, dtype):
    """The text of a helper function; lower-case f behind the names of those in single precision."""
    suffix = "f" if np.dtype(dtype) == np.float32 else ""
    text = HELPERS[name].replace("~", suffix).replace("@", TYPES[np.dtype(dtype)])
    text = text.replace("$", number(np.finfo(dtype).eps))
    return text.replace(f"#_{name}(", f"{prefix}_{name}{suffix if name != 'whole' else ''}(")
