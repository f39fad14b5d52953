/// @file
/// Micromechanical law: the tetrakaidecahedron of struts of Concha & Hurtado 2020.
#pragma once

#include "pulmo/input/options.hpp"
#include "pulmo/physics/tissue_law.hpp"

#include <array>

namespace pulmo {

/// Alveolar walls are the struts of a periodic tiling by truncated octahedra whose axes are those of stretch. Per cell
/// of volume V0 there are 12 struts of length E0 and cross-section A0, incompressible neo-Hookean, with energies
/// A0 E0 mu (l^2/2 + 1/l - 3/2), and 36 pairs of them that meet at 6 joints, k/2 (cos theta - cos theta0)^2.
/// W = least (struts + joints) / V0 over the places of the joints.
///
/// By the mirrors of the cell each joint moves along one axis, and joints that face each other move alike: three
/// unknowns s. Then there are three kinds of struts, four of each, with the components (l_t + s_t, l_u - s_u)
/// E0/sqrt(2) along the axes t = 1, 2, 3 and u, the next; for their stretch and their angle to t
///   tan(phi_t) = (l_u - s_u) / (l_t + s_t),
///   W = 4 v mu sum_t (l^2/2 + 1/l - 3/2)_t + K sum_t [2 cos^2(2 phi_t) + 4 (1/2 - sin(phi_t) cos(phi_u))^2],
///   v = A0 E0 / V0 = (1 - Phi0) / (12 - 9 d), K = k / V0 = alpha 3 mu I / (E0 V0) = 6 sqrt(2)/pi alpha mu v^2.
/// I = A0^2 / (4 pi), a round section, is that of the authors' code, to which their alpha belongs; the text has a
/// square one (alpha would be 5 % less). Formulas and values were read in the manuscript and the code of the authors.
///
/// Left out: their work of the gas on the struts' sides. Walls and gas are incompressible and gas is all around the
/// walls, so the whole stress is that of F less p I exactly; their term stands for that.
///
/// Free of stress at rest. Free inflation has its limit point at J = 4, whatever the parameters: 8.87 cmH2O with these.
/// No barrier at zero porosity. Where a stretch is below about 0.6 walls can fold out of the mirrors, and the law is
/// stiffer than the network (docs/effects/laws.md).
struct Concha {
  static constexpr const char *name = "concha", *alias = "";
  static constexpr const char *source = "Concha & Hurtado 2020; values of Hurtado, Aviles-Rojas & Concha 2023";

  struct Parameters {
    static constexpr const char *owner = "tissue";
    PetscScalar wall_modulus = 10.33;    ///< mu, kPa
    PetscScalar joint_stiffness = 10.05; ///< alpha, -
    PetscScalar overlap = 0.56;          ///< d, -
    PetscScalar porosity = 0.69;         ///< Phi0, -
  };

  static PetscErrorCode declare(Options &options, Parameters &k)
  {
    PetscFunctionBeginUser;
    PetscCall(options.real("wall_modulus", "kPa", Range::positive(), "shear modulus mu of the alveolar walls",
                           k.wall_modulus));
    PetscCall(options.real("joint_stiffness", "-", Range::positive(), "alpha: stiffness of the angles between walls",
                           k.joint_stiffness));
    PetscCall(options.real("overlap", "-", Range::between(0, 1), "share d of struts that others overlap", k.overlap));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// The law reads -tissue_porosity, and its default is that of the law.
  static PetscScalar &porosity(Parameters &k) { return k.porosity; }

  static StretchDerivatives of_stretches(const PetscScalar minus_1[3], const Parameters &k)
  {
    const Cell cell(k);
    StretchDerivatives e;
    PetscScalar s[3], B[3][3], Y[3][3]; // B = W_ss, Y = W_ss^-1 W_sl
    CellDerivatives d;
    if (!cell.settle(minus_1, s, d)) {
      constexpr PetscScalar none = std::numeric_limits<PetscScalar>::quiet_NaN();
      e.W = none;
      for (int a = 0; a < 3; ++a) {
        e.first[a] = none;
        for (int b = 0; b < 3; ++b) e.second[a][b] = none;
      }
      return e;
    }
    e.W = d.value;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) B[i][j] = d.second[3 + i][3 + j];
    factor(B);
    for (int a = 0; a < 3; ++a) {
      for (int i = 0; i < 3; ++i) Y[a][i] = d.second[3 + i][a];
      solve(B, Y[a]);
      e.first[a] = d.first[a];
    }
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) {
        e.second[a][b] = d.second[a][b];
        for (int i = 0; i < 3; ++i) e.second[a][b] -= d.second[a][3 + i] * Y[b][i];
      }
    return e;
  }

private:
  /// Energy of the cell and its derivatives by (l_1, l_2, l_3, s_1, s_2, s_3).
  struct CellDerivatives {
    PetscScalar value, first[6], second[6][6];
  };

  /// Cholesky's factor of @p B in its lower half; false if it is not positive definite.
  static bool factor(PetscScalar B[3][3])
  {
    for (int j = 0; j < 3; ++j) {
      for (int i = j; i < 3; ++i) {
        for (int m = 0; m < j; ++m) B[i][j] -= B[i][m] * B[j][m];
        if (i == j) {
          if (!(B[j][j] > 0)) return false;
          B[j][j] = std::sqrt(B[j][j]);
        } else {
          B[i][j] /= B[j][j];
        }
      }
    }
    return true;
  }
  /// Solves with the factor.
  static void solve(const PetscScalar B[3][3], PetscScalar x[3])
  {
    for (int i = 0; i < 3; ++i) {
      for (int m = 0; m < i; ++m) x[i] -= B[i][m] * x[m];
      x[i] /= B[i][i];
    }
    for (int i = 2; i >= 0; --i) {
      for (int m = i + 1; m < 3; ++m) x[i] -= B[m][i] * x[m];
      x[i] /= B[i][i];
    }
  }

  struct Cell {
    PetscScalar strut, joint; ///< 4 v mu, K: kPa

    explicit Cell(const Parameters &k)
    {
      const PetscScalar v = (1 - k.porosity) / (12 - 9 * k.overlap);
      strut = 4 * v * k.wall_modulus;
      joint = 6 * std::sqrt(2.) / PETSC_PI * k.joint_stiffness * k.wall_modulus * v * v;
    }

    /// @p from: 3 if the derivatives by s alone are wanted, 0 for all.
    template <int from>
    void derivatives(const PetscScalar minus_1[3], const PetscScalar s[3], CellDerivatives &d) const
    {
      // of the struts of each kind: stretch, cosines to both axes, what the stretch and the angle are by (l, s)
      PetscScalar l[3], c[3], n[3], slope[3], curvature[3];
      PetscScalar of_l[3][6] = {{0}}, of_phi[3][6] = {{0}};
      // of the joints, by the angles
      PetscScalar g[3], h[3][3];

      d.value = 0;
      PetscScalar l_1[3], ex[3], ey[3];
      for (int t = 0; t < 3; ++t) {
        const int u = (t + 1) % 3;
        ex[t] = minus_1[t] + s[t], ey[t] = minus_1[u] - s[u];
        const PetscScalar ll_1 = (ex[t] * (2 + ex[t]) + ey[t] * (2 + ey[t])) / 2;
        l[t] = std::sqrt(1 + ll_1);
        l_1[t] = ll_1 / (1 + l[t]);
        const PetscScalar r = 1 / l[t], half = std::sqrt(0.5);
        c[t] = half * r * (1 + ex[t]), n[t] = half * r * (1 + ey[t]);
        d.value += strut * l_1[t] * l_1[t] * (l[t] + 2) * r / 2;
        slope[t] = strut * l_1[t] * (l[t] * l[t] + l[t] + 1) * r * r;
        curvature[t] = strut * (1 + 2 * r * r * r);
        of_l[t][t] = of_l[t][3 + t] = half * c[t];
        of_l[t][u] = half * n[t], of_l[t][3 + u] = -half * n[t];
        of_phi[t][t] = of_phi[t][3 + t] = -half * r * n[t];
        of_phi[t][u] = half * r * c[t], of_phi[t][3 + u] = -half * r * c[t];
      }
      for (int t = 0; t < 3; ++t) {
        // struts of one kind: cos(2 phi) without cancellation at rest
        const PetscScalar C = (ex[t] - ey[t]) * (2 + ex[t] + ey[t]) / (2 * l[t] * l[t]), S = 2 * c[t] * n[t];
        d.value += 2 * joint * C * C;
        g[t] = -8 * joint * C * S;
        h[t][t] = 16 * joint * (S * S - C * C);
      }
      for (int t = 0; t < 3; ++t) {
        const int u = (t + 1) % 3;
        // 1/2 - sin(phi_t) cos(phi_u) without cancellation at rest
        const PetscScalar D = (l_1[t] + l_1[u] + l_1[t] * l_1[u] - ey[t] - ex[u] - ey[t] * ex[u]) / (2 * l[t] * l[u]);
        const PetscScalar D_t = -c[t] * c[u], D_u = n[t] * n[u], D_tt = n[t] * c[u], D_tu = c[t] * n[u];
        d.value += 4 * joint * D * D;
        g[t] += 8 * joint * D * D_t;
        g[u] += 8 * joint * D * D_u;
        h[t][t] += 8 * joint * (D_t * D_t + D * D_tt);
        h[u][u] += 8 * joint * (D_u * D_u + D * D_tt);
        h[t][u] = h[u][t] = 8 * joint * (D_t * D_u + D * D_tu);
      }
      for (int i = from; i < 6; ++i) {
        d.first[i] = 0;
        for (int t = 0; t < 3; ++t) d.first[i] += slope[t] * of_l[t][i] + g[t] * of_phi[t][i];
        for (int j = from; j < 6; ++j) d.second[i][j] = 0;
      }
      for (int t = 0; t < 3; ++t) {
        const PetscScalar turn = -g[t] / l[t];
        for (int j = from; j < 6; ++j) {
          // d2l = l dphi dphi, d2phi = -(dl dphi + dphi dl) / l
          const PetscScalar by_l = curvature[t] * of_l[t][j] + turn * of_phi[t][j];
          PetscScalar by_phi = slope[t] * l[t] * of_phi[t][j] + turn * of_l[t][j];
          for (int u = 0; u < 3; ++u) by_phi += h[t][u] * of_phi[u][j];
          for (int i = from; i < 6; ++i) d.second[i][j] += of_l[t][i] * by_l + of_phi[t][i] * by_phi;
        }
      }
    }

    /// Descends from @p s to equilibrium of the joints. False if that is no minimum.
    bool descend(const PetscScalar minus_1[3], PetscScalar s[3], CellDerivatives &d, PetscScalar done) const
    {
      constexpr int most = 60;
      constexpr PetscScalar longest = 0.3;
      derivatives<3>(minus_1, s, d);
      for (int iteration = 0; iteration < most && std::isfinite(d.value); ++iteration) {
        PetscScalar B[3][3], step[3], shift = 0, size = 0, slope = 0;
        const auto shifted = [&] {
          for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) B[i][j] = d.second[3 + i][3 + j] + (i == j ? shift : 0);
          return factor(B);
        };
        while (!shifted()) {
          shift = std::max(2 * shift, joint);
          if (!std::isfinite(shift)) return false; // derivatives that overflow
        }
        for (int i = 0; i < 3; ++i) step[i] = -d.first[3 + i];
        solve(B, step);
        for (int i = 0; i < 3; ++i) {
          size = std::max(size, std::abs(step[i]));
          slope += d.first[3 + i] * step[i];
        }
        if (size < done) {
          for (int i = 0; i < 3; ++i) s[i] += step[i];
          return shift == 0;
        }
        const PetscScalar start[3] = {s[0], s[1], s[2]}, before = d.value, rounding = 1e-14 * strut;
        for (PetscScalar part = std::min(PetscScalar(1), longest / size);; part /= 2) {
          if (part < 1e-10) return false;
          for (int i = 0; i < 3; ++i) s[i] = start[i] + part * step[i];
          derivatives<3>(minus_1, s, d);
          if (d.value <= before + 1e-4 * part * slope + rounding) break;
        }
      }
      return false;
    }

    /// The places @p s of the joints in equilibrium, and all derivatives @p d there: the minimum that is followed from
    /// uniform stretch, where all s are zero. False if it ends on the way.
    bool settle(const PetscScalar minus_1[3], PetscScalar s[3], CellDerivatives &d) const
    {
      constexpr PetscScalar longest = 0.4, rough = 1e-3, done = 1e-8; // a further step would be of its square
      const PetscScalar mean = (minus_1[0] + minus_1[1] + minus_1[2]) / 3;
      const PetscScalar share = (22 * joint - 3 * strut) / (22 * joint + 9 * strut); // exact for small strain
      if (!std::isfinite(mean)) return false;
      PetscScalar away = 0;
      for (int i = 0; i < 3; ++i) away = std::max(away, std::abs(minus_1[i] - mean));
      const int steps = 1 + static_cast<int>(std::min(PetscScalar(100), away / (longest * (1 + mean))));
      for (int i = 0; i < 3; ++i) s[i] = share * (minus_1[(i + 1) % 3] - minus_1[(i + 2) % 3]) / steps;
      for (int n = 1; n < steps; ++n) {
        PetscScalar at[3];
        for (int i = 0; i < 3; ++i) at[i] = mean + (minus_1[i] - mean) * n / steps;
        descend(at, s, d, rough);
      }
      if (!descend(minus_1, s, d, done)) return false;
      derivatives<0>(minus_1, s, d);
      return true;
    }
  };
};

} // namespace pulmo
