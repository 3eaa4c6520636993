"""Least-squares fit of dipoles to the blocks of a trace, neighbours that overlap fitted together.

Unknown offset, slope and curvature of each channel over the window are projected out of data and model alike, and so
is (by a share that is tracked) what all sensors of the array have in common: the earth's field as the car pitches.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

PARAMETERS = 6
"""s, y, h [m] and the moment's x, y, z [A m2] of each magnet."""
MODEL_ERROR = 0.05
"""Share of the field that the model may miss: gain, misalignment, axes converted one after the other."""
_HUBER = 3.0


@nb.njit(cache=True, nogil=True, fastmath=True)
def background_basis(s, scale, degree):  # type: ignore[no-untyped-def]
    """Orthonormal rows of scale, scale s, scale s2 (up to the degree), shape (degree + 1, K)."""
    mid = (s[0] + s[-1]) / 2
    half = max((s[-1] - s[0]) / 2, 1e-6)
    basis = np.empty((degree + 1, s.size))
    for q in range(degree + 1):
        for k in range(s.size):
            basis[q, k] = scale[k] * ((s[k] - mid) / half) ** q
        for other in range(q):
            dot = 0.0
            for k in range(s.size):
                dot += basis[q, k] * basis[other, k]
            for k in range(s.size):
                basis[q, k] -= dot * basis[other, k]
        norm = 0.0
        for k in range(s.size):
            norm += basis[q, k] ** 2
        norm = 1 / math.sqrt(max(norm, 1e-30))
        for k in range(s.size):
            basis[q, k] *= norm
    return basis


@nb.njit(cache=True, nogil=True, fastmath=True)
def remove_background(v, basis, alpha):  # type: ignore[no-untyped-def]
    """Project background and the common share out of v (S, 3, K), in place."""
    sensors, k_n = v.shape[0], v.shape[2]
    mean = np.empty(k_n)
    for axis in range(3):
        if alpha[axis] > 0:
            share = alpha[axis] / sensors
            mean[:] = 0
            for j in range(sensors):
                for k in range(k_n):
                    mean[k] += v[j, axis, k]
            for j in range(sensors):
                for k in range(k_n):
                    v[j, axis, k] -= share * mean[k]
        for j in range(sensors):
            for q in range(basis.shape[0]):
                dot = 0.0
                for k in range(k_n):
                    dot += basis[q, k] * v[j, axis, k]
                for k in range(k_n):
                    v[j, axis, k] -= dot * basis[q, k]


@nb.njit(cache=True, nogil=True, fastmath=True)
def dipole_columns(p, s, positions, delays, weight, out, derivatives):  # type: ignore[no-untyped-def]
    """Field of a magnet p (6,), whitened: out[6] the field, out[0..5] its derivatives (if wanted), (7, S, 3, K).

    weight (S, 3, K): 1 / noise, 0 where a sample is missing; delays (3, K): distance driven before an axis is read.
    """
    sensors, k_n = weight.shape[0], weight.shape[2]
    mx, my, mz = p[3], p[4], p[5]
    for j in range(sensors):
        y = positions[j, 1] - p[1]
        z = positions[j, 2] + p[2]
        for axis in range(3):
            # 1 for the axis, 0 for the others: no branches in the loops
            ex, ey, ez = 1.0 * (axis == 0), 1.0 * (axis == 1), 1.0 * (axis == 2)
            m = ex * mx + ey * my + ez * mz
            w, delay = weight[j, axis], delays[axis]
            ahead = positions[j, 0] - p[0]
            field = out[6, j, axis]
            if not derivatives:
                for k in range(k_n):
                    x = s[k] + delay[k] + ahead
                    r2 = x * x + y * y + z * z
                    f = 0.1 * w[k] / (r2 * r2 * math.sqrt(r2))
                    field[k] = f * (3 * (ex * x + ey * y + ez * z) * (mx * x + my * y + mz * z) - m * r2)
                continue
            d0, d1, d2 = out[0, j, axis], out[1, j, axis], out[2, j, axis]
            d3, d4, d5 = out[3, j, axis], out[4, j, axis], out[5, j, axis]
            for k in range(k_n):
                x = s[k] + delay[k] + ahead
                r2 = x * x + y * y + z * z
                f = 0.1 * w[k] / (r2 * r2 * math.sqrt(r2))
                along = mx * x + my * y + mz * z
                r = ex * x + ey * y + ez * z
                c = 15 * r * along / r2 - 3 * m
                field[k] = f * (3 * r * along - m * r2)
                d0[k] = -f * (3 * (r * mx + along * ex) - c * x)
                d1[k] = -f * (3 * (r * my + along * ey) - c * y)
                d2[k] = f * (3 * (r * mz + along * ez) - c * z)
                d3[k] = f * (3 * r * x - r2 * ex)
                d4[k] = f * (3 * r * y - r2 * ey)
                d5[k] = f * (3 * r * z - r2 * ez)


@nb.njit(cache=True, nogil=True, fastmath=True)
def _normal_equations(jacobian, rows, residual, gradient, hessian):  # type: ignore[no-untyped-def]
    """Weighted J r and J J' of J (P, R): by hand, so that the sums don't depend on a library's threads."""
    weighted = np.empty(rows.size)
    for a in range(jacobian.shape[0]):
        ja = jacobian[a]
        g = 0.0
        for i in range(rows.size):
            weighted[i] = ja[i] * rows[i]
            g += weighted[i] * residual[i]
        gradient[a] = g
        for b in range(a, jacobian.shape[0]):
            jb = jacobian[b]
            h = 0.0
            for i in range(rows.size):
                h += weighted[i] * jb[i]
            hessian[a, b] = h
            hessian[b, a] = h


@nb.njit(cache=True, nogil=True, fastmath=True)
def _model(params, s, positions, delays, weight, basis, alpha, columns, jacobian, total, derivatives):  # type: ignore[no-untyped-def]
    """Sum of the fields into total (S, 3, K), background removed; their size before that is returned."""
    size = np.zeros(total.shape)
    total[:] = 0
    for i in range(params.shape[0]):
        dipole_columns(params[i], s, positions, delays, weight, columns, derivatives)
        size += columns[6] ** 2
        total += columns[6]
        if derivatives:
            for q in range(PARAMETERS):
                remove_background(columns[q], basis, alpha)
                jacobian[PARAMETERS * i + q] = columns[q].ravel()
    remove_background(total, basis, alpha)
    return size


@nb.njit(cache=True, nogil=True)
def prior_terms(p, kind, prior, gradient, hessian, at):  # type: ignore[no-untyped-def]
    """Cost of a magnet p (6,) unlike the expected; its descent and curvature are added from place `at` on.

    kind: 2 for an upright magnet, 0 for one that lies forward. prior: moment and its spread [A m2], clearance and its
    spread [m], spread of what a tilt adds to the moment across its axis, and to the y component of a forward one.
    """
    m = math.sqrt(p[3] ** 2 + p[4] ** 2 + p[5] ** 2) + 1e-12
    off = (m - prior[0]) / prior[1]
    low = (p[2] - prior[2]) / prior[3]
    cost = off * off + low * low
    for q in range(3):
        gradient[at + 3 + q] -= p[3 + q] / m * off / prior[1]
        for r in range(3):
            hessian[at + 3 + q, at + 3 + r] += p[3 + q] * p[3 + r] / (m * prior[1]) ** 2
        if q != kind:
            spread = prior[5] if kind == 0 and q == 1 else prior[4]
            cost += (p[3 + q] / spread) ** 2
            gradient[at + 3 + q] -= p[3 + q] / spread**2
            hessian[at + 3 + q, at + 3 + q] += 1 / spread**2
    gradient[at + 2] -= low / prior[3]
    hessian[at + 2, at + 2] += 1 / prior[3] ** 2
    return cost


@nb.njit(cache=True, nogil=True, fastmath=True)
def _row_weights(residual, size, weight):  # type: ignore[no-untyped-def]
    """1 for noise alone; less where the field is strong (the model errs) or the sample is far off."""
    out = np.empty(residual.shape)
    for j in range(residual.shape[0]):
        for k in range(residual.shape[2]):
            field = size[j, 0, k] + size[j, 1, k] + size[j, 2, k]
            g = 1 / (1 + MODEL_ERROR * MODEL_ERROR * field)
            for axis in range(3):
                r = abs(residual[j, axis, k]) * math.sqrt(g)
                out[j, axis, k] = g * min(1.0, _HUBER / r) if r > _HUBER else g
                if weight[j, axis, k] == 0:
                    out[j, axis, k] = 0
    return out


@nb.njit(cache=True, nogil=True, fastmath=True)
def _robust_cost(residual, size, weight):  # type: ignore[no-untyped-def]
    """Sum of Huber's losses; the strength of the field lowers the weight as in `_row_weights`."""
    cost = 0.0
    for j in range(residual.shape[0]):
        for k in range(residual.shape[2]):
            field = size[j, 0, k] + size[j, 1, k] + size[j, 2, k]
            spread = 1 + MODEL_ERROR * MODEL_ERROR * field
            for axis in range(3):
                if weight[j, axis, k] > 0:
                    r = abs(residual[j, axis, k]) / math.sqrt(spread)
                    cost += (r * r if r < _HUBER else 2 * _HUBER * r - _HUBER * _HUBER) + math.log(spread)
    return cost


@nb.njit(cache=True, nogil=True, fastmath=True)
def fit_dipoles(s, data, weight, delays, positions, basis, alpha, start, kinds, prior, iterations):  # type: ignore[no-untyped-def]
    """Levenberg-Marquardt from start (n, 6).

    data (S, 3, K): whitened, background removed; kinds (n,) and prior as in `prior_terms`. If the last start has no
    moment, moments are first solved for with the places as they are.
    Returns params (n, 6), covariance (n, 6, 6) of each magnet, explained (n,): energy lost without it, local (n, 2):
    weighted residual energy and rows about it, prior costs (n,).
    """
    n = start.shape[0]
    sensors, k_n = data.shape[0], data.shape[2]
    size_p = PARAMETERS * n
    params = start.copy()
    columns = np.empty((7, sensors, 3, k_n))
    total = np.empty((sensors, 3, k_n))
    jacobian = np.empty((size_p, data.size))
    rows = np.ones(data.shape)
    hessian = np.empty((size_p, size_p))
    gradient = np.empty(size_p)
    damping = 1e-3
    cost = np.inf
    size = _model(params, s, positions, delays, weight, basis, alpha, columns, jacobian, total, True)
    linear = params[n - 1, 3] == 0 and params[n - 1, 5] == 0
    scrap_g, scrap_h = np.zeros(size_p), np.zeros((size_p, size_p))
    for _ in range(iterations):
        residual = data - total
        if not linear:
            rows = _row_weights(residual, size, weight)
        cost = (rows * residual * residual).sum()
        _normal_equations(jacobian, rows.ravel(), residual.ravel(), gradient, hessian)
        if linear:
            for i in range(n):  # places stay, moments are solved for
                for q in range(3):
                    a = PARAMETERS * i + q
                    hessian[a, :] = 0
                    hessian[:, a] = 0
                    hessian[a, a] = 1
                    gradient[a] = 0
                for q in range(3):
                    a = PARAMETERS * i + 3 + q
                    hessian[a, a] += 1e-3 if q == kinds[i] else 1 / prior[4] ** 2
                    if q != kinds[i]:
                        gradient[a] -= params[i, 3 + q] / prior[4] ** 2
            step = np.linalg.solve(hessian, gradient)
            params += step.reshape(n, PARAMETERS)
            linear = False
            for i in range(n):
                m = math.sqrt(params[i, 3] ** 2 + params[i, 4] ** 2 + params[i, 5] ** 2)
                params[i, 3:] *= min(max(m, 0.5 * prior[0]), 2 * prior[0]) / max(m, 1e-9)
            size = _model(params, s, positions, delays, weight, basis, alpha, columns, jacobian, total, True)
            continue
        for i in range(n):
            cost += prior_terms(params[i], kinds[i], prior, gradient, hessian, PARAMETERS * i)
        moved = False
        for _ in range(6):
            damped = hessian.copy()
            for a in range(size_p):
                damped[a, a] += damping * hessian[a, a] + 1e-9
            step = np.linalg.solve(damped, gradient).reshape(n, PARAMETERS)
            for i in range(n):
                for q in range(3):
                    step[i, q] = min(max(step[i, q], -0.08), 0.08)
            trial = params + step
            for i in range(n):
                trial[i, 2] = min(max(trial[i, 2], 0.04), 0.9)
            size_t = _model(trial, s, positions, delays, weight, basis, alpha, columns, jacobian, total, False)
            trial_cost = (rows * (data - total) ** 2).sum()
            for i in range(n):
                trial_cost += prior_terms(trial[i], kinds[i], prior, scrap_g, scrap_h, PARAMETERS * i)
            if trial_cost < cost:
                params, size = trial, size_t
                damping *= 0.2
                moved = True
                break
            damping = max(damping * 8, 1e-4)
        if not moved:
            break
        if cost - trial_cost < 1e-3 * cost + 0.01:
            break
        size = _model(params, s, positions, delays, weight, basis, alpha, columns, jacobian, total, True)
    size = _model(params, s, positions, delays, weight, basis, alpha, columns, jacobian, total, False)
    residual = data - total
    rows = _row_weights(residual, size, weight)
    covariance = np.zeros((n, PARAMETERS, PARAMETERS))
    explained = np.zeros(n)
    local = np.zeros((n, 2))
    whole = np.linalg.inv(hessian + 1e-9 * np.eye(size_p))
    for i in range(n):
        a = PARAMETERS * i
        covariance[i] = whole[a : a + PARAMETERS, a : a + PARAMETERS]
        dipole_columns(params[i], s, positions, delays, weight, columns, False)
        one = columns[6]
        remove_background(one, basis, alpha)
        explained[i] = (rows * ((residual + one) ** 2 - residual**2)).sum()
        reach = 1.2 * params[i, 2] + 0.1
        for j in range(sensors):
            if abs(positions[j, 1] - params[i, 1]) > reach:
                continue
            for k in range(k_n):
                if abs(s[k] - params[i, 0]) < reach:
                    for axis in range(3):
                        if weight[j, axis, k] > 0:
                            g = rows[j, axis, k]
                            local[i, 0] += g * residual[j, axis, k] ** 2
                            local[i, 1] += 1
    prior_costs = np.empty(n)
    for i in range(n):
        prior_costs[i] = prior_terms(params[i], kinds[i], prior, scrap_g, scrap_h, PARAMETERS * i)
    return params, covariance, explained, local, prior_costs


@nb.njit(cache=True, nogil=True, fastmath=True)
def residual_cost(s, data, weight, delays, positions, basis, alpha, params):  # type: ignore[no-untyped-def]
    """-2 log likelihood (Huber's) of what magnets (n, 6) leave of the data; arguments as of `fit_dipoles`."""
    columns = np.empty((7, data.shape[0], 3, data.shape[2]))
    total = np.empty(data.shape)
    size = _model(params, s, positions, delays, weight, basis, alpha, columns, np.empty((0, 0)), total, False)
    return _robust_cost(data - total, size, weight)
