"""The sums over a tile: whitening, the loss and its weights, the 28 sums of H, b and c.

The second derivative of rho(s) / 2 is J^T (psi I + 2 psi' r r^T) J, but for the second derivative
of r. In the axes along the residual and across it the middle is diagonal, so that it is summed
like H, with another weight along.
"""

import math

from factors.compiled import compiled
from factors.kernel_projection import (
    ACROSS,
    FAST,
    PRODUCT,
    PSI,
    RU,
    RV,
    UX,
    UY,
    UZ,
    VX,
    VY,
    VZ,
    A,
    B,
    W,
    X,
    Y,
    Z,
)
from factors.loss import CAUCHY, loss_and_weight, weight_along

_SMALL = 1e-100  # far from the smallest float by more than four factors


@compiled(part=True, fastmath=FAST)
def whiten(whitening, start, n, tile):  # type: ignore[no-untyped-def]
    """Multiply residuals and derivatives by the whitening matrices, or by numbers."""
    if whitening.shape[0] == 0:
        return
    diagonal = whitening.shape[0] == 1
    for i in range(n):
        s00 = whitening[0, start + i]
        s01 = 0.0 if diagonal else whitening[1, start + i]
        s11 = s00 if diagonal else whitening[2, start + i]
        tile[RU, i] = s00 * tile[RU, i] + s01 * tile[RV, i]
        tile[UX, i] = s00 * tile[UX, i] + s01 * tile[VX, i]
        tile[UY, i] = s00 * tile[UY, i] + s01 * tile[VY, i]
        tile[UZ, i] = s00 * tile[UZ, i] + s01 * tile[VZ, i]
        tile[RV, i] *= s11
        tile[VX, i] *= s11
        tile[VY, i] *= s11
        tile[VZ, i] *= s11


@compiled(part=True, fastmath=FAST)
def scale_residuals(whitening, start, n, tile):  # type: ignore[no-untyped-def]
    """Multiply residuals by their weights w, if these are numbers."""
    if whitening.shape[0] == 0:
        return
    ru, rv, weights = tile[RU], tile[RV], whitening[0][start:]
    for i in range(n):
        ru[i] *= weights[i]
        rv[i] *= weights[i]


@compiled(part=True, fastmath=FAST)
def weigh(loss, scale, n, tile):  # type: ignore[no-untyped-def]
    """Fill in the weights psi; return the sum of rho."""
    ru, rv, psi = tile[RU], tile[RV], tile[PSI]
    if loss != CAUCHY:
        cost = 0.0
        for i in range(n):
            rho, psi[i] = loss_and_weight(loss, scale, ru[i] * ru[i] + rv[i] * rv[i])
            cost += rho
        return cost
    k = 1.0 / (scale * scale)
    for i in range(n):
        psi[i] = 1.0 / (1.0 + k * (ru[i] * ru[i] + rv[i] * rv[i]))
    return -_sum_of_logarithms(psi, n, tile[PRODUCT]) / k


@compiled(part=True, fastmath=FAST)
def _sum_of_logarithms(values, n, products):  # type: ignore[no-untyped-def]
    """The logarithm of the product of ``n`` values, taken before it leaves the range of a float.

    A multiplication each, most of them vectorized, instead of a logarithm.
    """
    quarter = n // 4
    second, third, fourth = values[quarter:], values[2 * quarter :], values[3 * quarter :]
    for i in range(quarter):
        products[i] = (values[i] * second[i]) * (third[i] * fourth[i])
    logarithms, even, odd = 0.0, 1.0, 1.0  # two, because one would wait for itself
    for i in range(quarter // 2):
        even *= products[2 * i]
        odd *= products[2 * i + 1]
        if even < _SMALL or odd < _SMALL:
            logarithms += math.log(even) + math.log(odd)
            even = odd = 1.0
    if quarter % 2:
        odd *= products[quarter - 1]
    for i in range(4 * quarter, n):
        even *= values[i]
    return logarithms + math.log(even) + math.log(odd)


@compiled(part=True, fastmath=FAST)
def turn_to_residuals(loss, scale, n, tile):  # type: ignore[no-untyped-def]
    """Derivatives along the residual and across it, in place of u and v, and their weights."""
    ru, rv, along, across = tile[RU], tile[RV], tile[PSI], tile[ACROSS]
    ux, uy, uz, vx, vy, vz = tile[UX], tile[UY], tile[UZ], tile[VX], tile[VY], tile[VZ]
    for i in range(n):
        s = ru[i] * ru[i] + rv[i] * rv[i]
        size = math.sqrt(s)
        c, d = (ru[i] / size, rv[i] / size) if s > 0.0 else (1.0, 0.0)
        u0, u1, u2, v0, v1, v2 = ux[i], uy[i], uz[i], vx[i], vy[i], vz[i]
        ux[i], uy[i], uz[i] = c * u0 + d * v0, c * u1 + d * v1, c * u2 + d * v2
        vx[i], vy[i], vz[i] = c * v0 - d * u0, c * v1 - d * u1, c * v2 - d * u2
        across[i] = along[i]
        along[i] = weight_along(loss, scale, s, across[i])


@compiled(part=True, fastmath=FAST)
def sum_tile(n, tile, of_v, out):  # type: ignore[no-untyped-def]
    """Add the 21 sums of H = J^T psi J of a tile; ``of_v``: the weights of v, PSI has those of u.

    q = X^-1 p has dq / d(rotation, translation) = ([q]x, -I), and g^T [q]x = (g x q)^T. With the
    3x3 matrix m = psi g g^T, summed over u and v, and c = m [q]x, the blocks of H are [q]x^T c, c
    and m, but for signs.
    """
    d00 = d01 = d02 = d11 = d12 = d22 = m00 = m01 = m02 = m11 = m12 = m22 = 0.0
    c00 = c01 = c02 = c10 = c11 = c12 = c20 = c21 = c22 = 0.0
    rx, ry, rz, of_u = tile[X], tile[Y], tile[Z], tile[PSI]
    ux, uy, uz, vx, vy, vz = tile[UX], tile[UY], tile[UZ], tile[VX], tile[VY], tile[VZ]
    for i in range(n):
        x, y, z, p, q = rx[i], ry[i], rz[i], of_u[i], of_v[i]
        u0, u1, u2, v0, v1, v2 = ux[i], uy[i], uz[i], vx[i], vy[i], vz[i]
        p0, p1, p2, q0, q1, q2 = p * u0, p * u1, p * u2, q * v0, q * v1, q * v2
        xx, xy, xz = p0 * u0 + q0 * v0, p0 * u1 + q0 * v1, p0 * u2 + q0 * v2
        yy, yz, zz = p1 * u1 + q1 * v1, p1 * u2 + q1 * v2, p2 * u2 + q2 * v2
        # Of the rows of c^T: rotation about an axis, by x, y, z.
        ax, ay, az = xy * z - xz * y, yy * z - yz * y, yz * z - zz * y
        bx, by, bz = xz * x - xx * z, yz * x - xy * z, zz * x - xz * z
        cx, cy, cz = xx * y - xy * x, xy * y - yy * x, xz * y - yz * x
        d00 += ay * z - az * y
        d01 += az * x - ax * z
        d02 += ax * y - ay * x
        d11 += bz * x - bx * z
        d12 += bx * y - by * x
        d22 += cx * y - cy * x
        c00 += ax
        c01 += ay
        c02 += az
        c10 += bx
        c11 += by
        c12 += bz
        c20 += cx
        c21 += cy
        c22 += cz
        m00 += xx
        m01 += xy
        m02 += xz
        m11 += yy
        m12 += yz
        m22 += zz
    sums = (
        d00, d01, d02, -c00, -c01, -c02, d11, d12, -c10, -c11, -c12, d22, -c20, -c21, -c22,
        m00, m01, m02, m11, m12, m22,
    )  # fmt: skip
    for k in range(21):
        out[k] += sums[k]


@compiled(part=True, fastmath=FAST)
def apply_weights(whitening, start, n, tile):  # type: ignore[no-untyped-def]
    """Turn the residuals w r into psi w^2 r, and psi into psi w^2, if the weights are numbers."""
    ru, rv, psi = tile[RU], tile[RV], tile[PSI]
    if whitening.shape[0] == 0:
        for i in range(n):
            ru[i] *= psi[i]
            rv[i] *= psi[i]
        return
    weights = whitening[0][start:]
    for i in range(n):
        w = weights[i]
        ru[i] *= psi[i] * w
        rv[i] *= psi[i] * w
        psi[i] *= w * w


@compiled(part=True, fastmath=FAST)
def sum_rays(lens, n, tile, out):  # type: ignore[no-untyped-def]
    """Add the 21 sums of H of a tile of a pinhole, from a = x/z, b = y/z, w = 1/z, psi and psi r.

    The rows of the Jacobian are fx (ab, -A, b, -w, 0, aw) and fy (B, -ab, -a, 0, -w, bw) with
    A = 1 + a^2 and B = 1 + b^2: their 21 products share most of their terms, and the focal lengths
    come in at the end. ``u05``: of the first row's entries 0 and 5, without sign and focal length.
    """
    ray_a, ray_b, ray_w, weight = tile[A], tile[B], tile[W], tile[PSI]
    u00 = v00 = u11 = u01 = v01 = u02 = v02 = u12 = v12 = u22 = v22 = 0.0
    for i in range(n):
        a, b, psi = ray_a[i], ray_b[i], weight[i]
        big_a, big_b, ab = 1.0 + a * a, 1.0 + b * b, a * b
        psi_ab, psi_a, psi_b = psi * ab, psi * big_a, psi * big_b
        u00 += psi_ab * ab
        v00 += psi_b * big_b
        u11 += psi_a * big_a
        u01 += psi_ab * big_a
        v01 += psi_ab * big_b
        u02 += psi_ab * b
        v02 += psi_b * a
        u12 += psi_a * b
        v12 += psi_ab * a
        u22 += psi * b * b
        v22 += psi * a * a
    u03 = v04 = u13 = u05 = v15 = v05 = u15 = v24 = u23 = u33 = u35 = v45 = u55 = v55 = 0.0
    for i in range(n):
        a, b, w, psi = ray_a[i], ray_b[i], ray_w[i], weight[i]
        psi_ab, psi_a, psi_b = psi * a * b, psi * (1.0 + a * a), psi * (1.0 + b * b)
        aw, bw = a * w, b * w
        u03 += psi_ab * w
        v04 += psi_b * w
        u13 += psi_a * w
        u05 += psi_ab * aw
        v15 += psi_ab * bw
        v05 += psi_b * bw
        u15 += psi_a * aw
        v24 += psi * aw
        u23 += psi * bw
        u33 += psi * w * w
        u35 += psi * w * aw
        v45 += psi * w * bw
        u55 += psi * aw * aw
        v55 += psi * bw * bw
    fx, fy = lens[0], lens[1]
    p, q = fx * fx, fy * fy
    sums = (
        p * u00 + q * v00, -p * u01 - q * v01, p * u02 - q * v02, -p * u03, -q * v04,
        p * u05 + q * v05, p * u11 + q * u00, -p * u12 + q * v12, p * u13, q * u03,
        -p * u15 - q * v15, p * u22 + q * v22, -p * u23, q * v24, (p - q) * u03,
        p * u33, 0.0, -p * u35, q * u33, -q * v45, p * u55 + q * v55,
    )  # fmt: skip
    for k in range(21):
        out[k] += sums[k]


@compiled(part=True, fastmath=FAST)
def sum_ray_gradients(lens, n, tile, out):  # type: ignore[no-untyped-def]
    """Add the gradient of a tile of a pinhole to the sums, see ``sum_rays``."""
    pull_u, pull_v = tile[RU], tile[RV]
    ray_a, ray_b, ray_w = tile[A], tile[B], tile[W]
    fx, fy = lens[0], lens[1]
    b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    for i in range(n):
        a, b, w, u, v = ray_a[i], ray_b[i], ray_w[i], fx * pull_u[i], fy * pull_v[i]
        both = a * u + b * v
        b0 += b * both + v
        b1 -= a * both + u
        b2 += b * u - a * v
        b3 -= w * u
        b4 -= w * v
        b5 += w * both
    sums = (b0, b1, b2, b3, b4, b5)
    for k in range(6):
        out[21 + k] += sums[k]


@compiled(part=True, fastmath=FAST)
def sum_tile_gradients(n, tile, out):  # type: ignore[no-untyped-def]
    """Add J^T psi r of a tile to the sums, see ``sum_tile``."""
    rx, ry, rz, rp = tile[X], tile[Y], tile[Z], tile[PSI]
    ux, uy, uz, vx, vy, vz = tile[UX], tile[UY], tile[UZ], tile[VX], tile[VY], tile[VZ]
    res_u, res_v = tile[RU], tile[RV]
    b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    for i in range(n):
        pull_u, pull_v = rp[i] * res_u[i], rp[i] * res_v[i]
        g3 = -(pull_u * ux[i] + pull_v * vx[i])
        g4 = -(pull_u * uy[i] + pull_v * vy[i])
        g5 = -(pull_u * uz[i] + pull_v * vz[i])
        x, y, z = rx[i], ry[i], rz[i]
        b0 += g5 * y - g4 * z
        b1 += g3 * z - g5 * x
        b2 += g4 * x - g3 * y
        b3 += g3
        b4 += g4
        b5 += g5
    sums = (b0, b1, b2, b3, b4, b5)
    for k in range(6):
        out[21 + k] += sums[k]
