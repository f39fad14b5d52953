/// @file
/// The periodic network of struts of Concha & Hurtado 2020 with all joints free to move in space: the corners of a
/// tiling by truncated octahedra, found as points, with struts between neighbours. It knows of no mirrors.
#pragma once

#include "unit/tensors.hpp"

#include <cmath>
#include <vector>

namespace pulmo::test {

class FreeCell {
public:
  static constexpr int joints = 6, unknowns = 3 * (joints - 1); // the first stays
  using Places = std::array<double, 3 * joints>;

  struct Tissue {
    double mu = 10.33, alpha = 10.05, d = 0.56, porosity = 0.69;
  };
  struct State {
    Places u{};          ///< displacement of the joints beyond F
    double W = 0;        ///< kPa
    Tensor P{};          ///< dW/dF, kPa
    double force = 0;    ///< largest force on a joint
    bool stable = false; ///< its stiffness is positive definite
  };

  explicit FreeCell(const Tissue &t)
  {
    // of a truncated octahedron the permutations of (0, +-1, +-2)/3, of which six are of one cell
    const int order[joints][3] = {{0, 1, 2}, {1, 0, 2}, {2, 0, 1}, {2, 1, 0}, {1, 2, 0}, {0, 2, 1}};
    for (const auto &o : order) corners_.push_back({o[0] / 3., o[1] / 3., o[2] / 3.});
    const double g = 2. / 3, lattice[3][3] = {{-g, g, g}, {g, -g, g}, {g, g, -g}};
    for (int i = 0; i < joints; ++i)
      for (int j = 0; j < joints; ++j)
        for (int p = -2; p <= 2; ++p)
          for (int q = -2; q <= 2; ++q)
            for (int r = -2; r <= 2; ++r) {
              Strut s{i, j, {}};
              double length = 0;
              for (int k = 0; k < 3; ++k) {
                s.D[k] = corners_[j][k] - corners_[i][k] + p * lattice[0][k] + q * lattice[1][k] + r * lattice[2][k];
                length += s.D[k] * s.D[k];
              }
              if (std::abs(std::sqrt(length) - E0) < 1e-9) struts_.push_back(s);
            }
    const double A0 = 32 * std::sqrt(2.) * (1 - t.porosity) * (E0 / 2) * (E0 / 2) / (12 - 9 * t.d);
    strut_ = A0 * E0 * t.mu;
    joint_ = t.alpha * 3 * t.mu * A0 * A0 / (4 * PETSC_PI) / E0;
  }

  /// Struts that meet at each joint, both ends counted.
  std::size_t ends() const { return struts_.size(); }

  /// Equilibrium at F = diag(stretch), followed from rest in @p steps; @p noise moves the joints before each.
  State follow(const double stretch[3], int steps, double noise, unsigned seed = 1) const
  {
    Random random(seed);
    State s;
    for (int n = 1; n <= steps; ++n) {
      Tensor F{};
      for (int k = 0; k < 3; ++k) F[4 * k] = std::pow(stretch[k], static_cast<double>(n) / steps);
      for (int i = 3; i < 3 * joints; ++i) s.u[i] += random(-noise, noise);
      settle(F, s);
    }
    return s;
  }

private:
  static constexpr double E0 = 0.47140452079103168, V0 = 32. / 27; // sqrt(2)/3, 64 sqrt(2) (E0/2)^3
  struct Strut {
    int i, j;
    double D[3];
  };

  /// Energy of the cell; @p force: its derivative by u.
  double energy(const Tensor &F, const Places &u, Places &force, Tensor &P) const
  {
    double E = 0;
    std::vector<std::array<double, 3>> d(struts_.size()), by_d(struts_.size());
    std::vector<double> length(struts_.size());
    for (std::size_t n = 0; n < struts_.size(); ++n) {
      const Strut &s = struts_[n];
      double dd = 0;
      for (int k = 0; k < 3; ++k) {
        d[n][k] = u[3 * s.j + k] - u[3 * s.i + k];
        for (int m = 0; m < 3; ++m) d[n][k] += F[3 * k + m] * s.D[m];
        dd += d[n][k] * d[n][k];
      }
      length[n] = std::sqrt(dd);
      const double l = length[n] / E0; // each strut is seen from both ends
      E += strut_ / 2 * (l * l / 2 + 1 / l - 1.5);
      for (int k = 0; k < 3; ++k) by_d[n][k] = strut_ / 2 * (l - 1 / (l * l)) / E0 * d[n][k] / length[n];
    }
    for (std::size_t n = 0; n < struts_.size(); ++n)
      for (std::size_t m = 0; m < n; ++m) {
        if (struts_[n].i != struts_[m].i) continue;
        double c = 0, c0 = 0;
        for (int k = 0; k < 3; ++k) {
          c += d[n][k] * d[m][k] / (length[n] * length[m]);
          c0 += struts_[n].D[k] * struts_[m].D[k] / (E0 * E0);
        }
        E += joint_ / 2 * (c - c0) * (c - c0);
        for (int k = 0; k < 3; ++k) {
          const double a = d[n][k] / length[n], b = d[m][k] / length[m];
          by_d[n][k] += joint_ * (c - c0) * (b - c * a) / length[n];
          by_d[m][k] += joint_ * (c - c0) * (a - c * b) / length[m];
        }
      }
    force.fill(0);
    P.fill(0);
    for (std::size_t n = 0; n < struts_.size(); ++n)
      for (int k = 0; k < 3; ++k) {
        force[3 * struts_[n].j + k] += by_d[n][k];
        force[3 * struts_[n].i + k] -= by_d[n][k];
        for (int m = 0; m < 3; ++m) P[3 * k + m] += by_d[n][k] * struts_[n].D[m] / V0;
      }
    return E / V0;
  }

  /// Newton's method with the stiffness from differences of the forces, shifted where it is not positive definite.
  void settle(const Tensor &F, State &s) const
  {
    Places f;
    Tensor P;
    double W = energy(F, s.u, f, P);
    for (int iteration = 0; iteration < 200; ++iteration) {
      s.force = 0;
      for (int i = 3; i < 3 * joints; ++i) s.force = std::max(s.force, std::abs(f[i]));
      double K[unknowns][unknowns], step[unknowns];
      for (int c = 0; c < unknowns; ++c) {
        constexpr double h = 1e-6;
        Places up = s.u, down = s.u, f_up, f_down;
        up[3 + c] += h, down[3 + c] -= h;
        energy(F, up, f_up, P);
        energy(F, down, f_down, P);
        for (int r = 0; r < unknowns; ++r) K[r][c] = (f_up[3 + r] - f_down[3 + r]) / (2 * h);
      }
      for (double shift = 0;; shift = std::max(2 * shift, 0.1 * joint_)) {
        double L[unknowns][unknowns];
        double least = 1e30;
        for (int j = 0; j < unknowns && least > 0; ++j)
          for (int i = j; i < unknowns; ++i) {
            L[i][j] = (K[i][j] + K[j][i]) / 2 + (i == j ? shift : 0);
            for (int m = 0; m < j; ++m) L[i][j] -= L[i][m] * L[j][m];
            if (i == j) least = std::min(least, L[j][j]);
            if (!(least > 0)) break;
            L[i][j] = i == j ? std::sqrt(L[j][j]) : L[i][j] / L[j][j];
          }
        if (!(least > 0)) continue;
        for (int i = 0; i < unknowns; ++i) {
          step[i] = -f[3 + i];
          for (int m = 0; m < i; ++m) step[i] -= L[i][m] * step[m];
          step[i] /= L[i][i];
        }
        for (int i = unknowns - 1; i >= 0; --i) {
          for (int m = i + 1; m < unknowns; ++m) step[i] -= L[m][i] * step[m];
          step[i] /= L[i][i];
        }
        s.stable = shift == 0;
        break;
      }
      double size = 0;
      for (const double x : step) size = std::max(size, std::abs(x));
      const Places start = s.u;
      const double before = W;
      double part = std::min(1., 0.05 / size);
      for (;; part /= 2) {
        for (int i = 0; i < unknowns; ++i) s.u[3 + i] = start[3 + i] + part * step[i];
        W = energy(F, s.u, f, P);
        if (W <= before + 1e-13 * strut_ || part < 1e-9) break;
      }
      if (size < 1e-13) break;
    }
    s.W = energy(F, s.u, f, s.P);
  }

  std::vector<std::array<double, 3>> corners_;
  std::vector<Strut> struts_;
  double strut_, joint_;
};

} // namespace pulmo::test
