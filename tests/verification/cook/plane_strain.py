"""Cook's membrane in plane strain with elements of high degree in two dimensions: nothing of pulmo.

Quadrilaterals, displacement of degree k; incompressible neo-Hookean with a continuous pressure of degree k - 1 (Taylor-Hood),
or nearly incompressible with the displacement alone, which locks for k = 1.
"""
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

CORNERS = np.array([[0.0, 0], [48, 44], [48, 60], [0, 44]])  # mm, clamped on the side from the last to the first
TIPS = np.array([[48.0, 60], [48, 52]])  # upper corner and middle of the right side
TRACTION = 6.25  # kPa upwards on the right side, of the reference area: 100 in all for a thickness of 1
SHEAR = 80.1938  # kPa
BULK = 400889.8  # kPa, of the displacement alone


def legendre_nodes(k):
    """k + 1 Gauss-Lobatto points on [0, 1]."""
    inner = np.polynomial.legendre.Legendre.basis(k).deriv().roots() if k > 1 else []
    return (np.hstack([-1, np.sort(np.real(inner)), 1]) + 1) / 2


def lagrange(nodes, x):
    """Values and slopes (points, nodes) of the polynomials through the nodes."""
    monomials = np.vander(nodes, increasing=True)
    powers = np.vander(x, len(nodes), increasing=True)
    slopes = np.zeros_like(powers)
    slopes[:, 1:] = powers[:, :-1] * np.arange(1, len(nodes))
    inverse = np.linalg.inv(monomials)
    return powers @ inverse, slopes @ inverse


def numbering(cells, k):
    """Node numbers (cells^2, (k + 1)^2) of continuous elements of degree k on a square of cells."""
    n = k * cells + 1
    local = (np.arange(k + 1)[:, None] * n + np.arange(k + 1)).ravel()
    first = (np.arange(cells)[:, None] * n + np.arange(cells)).ravel() * k
    return first[:, None] + local


def graded(cells, power):
    """Points of [0, 1], from both ends to the middle as the powers of equal steps."""
    t = np.linspace(0, 1, cells + 1)
    return np.where(t <= 0.5, (2 * t)**power / 2, 1 - (2 - 2 * t)**power / 2)


@dataclass
class Membrane:
    """cells x cells elements of degree `degree`."""
    cells: int
    degree: int
    mixed: bool = True     # with a pressure; else displacement alone and BULK
    grading: float = 1     # > 1: cells gather at the sides and corners

    def __post_init__(self):
        k, m = self.degree, self.cells
        nodes = legendre_nodes(k)
        q, w = np.polynomial.legendre.leggauss(k + 2)
        q, w = (q + 1) / 2, w / 2
        along = [graded(m, self.grading)] * 2
        size = [np.diff(a) for a in along]
        N, dN = lagrange(nodes, q)
        # element (i, j), node (a, b), point (r, s): index i, a, r along the first edge
        values = np.einsum("ra,sb->rsab", N, N).reshape(len(q)**2, -1)
        slopes = np.stack([np.einsum("ra,sb->rsab", dN, N), np.einsum("ra,sb->rsab", N, dN)], -1).reshape(len(q)**2, -1, 2)
        self.u_of = numbering(m, k)
        self.n_u = 2 * (k * m + 1)**2
        xi = (along[0][:-1, None] + size[0][:, None] * nodes).reshape(m, -1)
        eta = (along[1][:-1, None] + size[1][:, None] * nodes).reshape(m, -1)
        places = np.stack(np.broadcast_arrays(xi[:, None, :, None], eta[None, :, None, :]), -1).reshape(m * m, -1, 2)
        x, y = places[..., 0], places[..., 1]
        shape = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], -1)
        X = shape @ CORNERS  # bilinear, so nodes of any degree hold the map
        self.points = np.zeros((self.n_u // 2, 2))
        self.points[self.u_of] = X
        jacobian = np.einsum("eni,qnj->eqij", X, slopes)
        self.weight = np.outer(w, w).ravel() * np.linalg.det(jacobian)
        self.B = np.einsum("qnj,eqji->eqni", slopes, np.linalg.inv(jacobian))  # Grad of the nodes' functions
        self.n_p = 0
        if self.mixed:
            M = lagrange(legendre_nodes(k - 1), q)[0] if k > 1 else np.ones((len(q), 1))
            self.p_values = np.einsum("ra,sb->rsab", M, M).reshape(len(q)**2, -1)
            self.p_of = numbering(m, k - 1)
            self.n_p = ((k - 1) * m + 1)**2
        self.load = np.zeros(self.n_u)
        edge = self.u_of.reshape(m, m, k + 1, k + 1)[-1, :, -1, :]  # right side, one row for each element
        height = CORNERS[2, 1] - CORNERS[1, 1]
        np.add.at(self.load, 2 * edge + 1, TRACTION * height * size[1][:, None] * (w @ N))
        clamped = np.unique(self.u_of.reshape(m, m, k + 1, k + 1)[0, :, 0, :])
        self.free = np.setdiff1d(np.arange(self.n_u + self.n_p), np.hstack([2 * clamped, 2 * clamped + 1]))

    def equations(self, state, share):
        """Residual and its derivative under a share of the load."""
        n_e, n_q, n_n = self.B.shape[:3]
        u = state[:self.n_u].reshape(-1, 2)[self.u_of]
        F = np.eye(2) + np.einsum("eni,eqnj->eqij", u, self.B)
        J = np.linalg.det(F)
        if J.min() <= 0:
            raise ArithmeticError("J <= 0")
        cof = np.stack([np.stack([F[..., 1, 1], -F[..., 1, 0]], -1), np.stack([-F[..., 0, 1], F[..., 0, 0]], -1)], -2)
        p = self.p_values @ state[self.n_u:][self.p_of].T if self.mixed else None
        p = p.T if self.mixed else SHEAR - BULK * (J - 1)
        P = SHEAR * F - p[..., None, None] * cof
        # dP/dF: mu 1 - p dcof/dF (+ K cof x cof); dcof_ij/dF_kl = e_ik e_jl in two dimensions
        e = np.array([[0.0, 1], [-1, 0]])
        identity = np.einsum("ik,jl->ijkl", np.eye(2), np.eye(2))
        A = SHEAR * identity - p[..., None, None, None, None] * np.einsum("ik,jl->ijkl", e, e)
        if not self.mixed:
            A = A + BULK * np.einsum("eqij,eqkl->eqijkl", cof, cof)
        f = np.einsum("eq,eqij,eqnj->eni", self.weight, P, self.B)
        residual = np.zeros(self.n_u + self.n_p)
        dofs = (2 * self.u_of[..., None] + np.arange(2)).reshape(n_e, -1)
        np.add.at(residual, dofs, f.reshape(n_e, -1))
        residual[:self.n_u] -= share * self.load
        AB = np.einsum("eq,eqijkl,eqml->eqijmk", self.weight, A, self.B, optimize=True)
        K = np.einsum("eqijmk,eqnj->enimk", AB, self.B, optimize=True).reshape(n_e, 2 * n_n, 2 * n_n)
        blocks = [(dofs, dofs, K)]
        if self.mixed:
            rows = self.n_u + self.p_of
            np.add.at(residual, rows, -np.einsum("eq,eq,qm->em", self.weight, J - 1, self.p_values))
            G = -np.einsum("eq,eqij,eqnj,qm->enim", self.weight, cof, self.B, self.p_values, optimize=True)
            G = G.reshape(n_e, 2 * n_n, -1)
            blocks += [(dofs, rows, G), (rows, dofs, G.transpose(0, 2, 1))]
        i = np.hstack([np.broadcast_to(r[:, :, None], b.shape).ravel() for r, c, b in blocks])
        j = np.hstack([np.broadcast_to(c[:, None, :], b.shape).ravel() for r, c, b in blocks])
        v = np.hstack([b.ravel() for r, c, b in blocks])
        return residual, sp.csc_matrix((v, (i, j)), shape=(len(residual),) * 2)

    def solve(self, share=1.0, steps=4, tolerance=1e-9):
        """Vertical displacement (mm) at TIPS under a share of the load."""
        state = np.zeros(self.n_u + self.n_p)
        if self.mixed:
            state[self.n_u:] = SHEAR  # free of stress
        for step in range(1, steps + 1):
            for _ in range(30):
                residual, K = self.equations(state, share * step / steps)
                change = spsolve(K[self.free][:, self.free], -residual[self.free])
                state[self.free] += change
                if np.abs(change[:100]).max() < tolerance * 48 and np.linalg.norm(residual[self.free]) < 1e-8 * SHEAR:
                    break
            else:
                raise ArithmeticError("Newton did not converge")
        return [state[2 * np.linalg.norm(self.points - place, axis=1).argmin() + 1] for place in TIPS]
