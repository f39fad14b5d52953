/// @file
/// The column 0 <= X <= L = 1 mm of meshes/column.msh on rollers (uniaxial strain, F = diag(J, 1, 1)), its tissue law
/// in closed form, and the solution of the diffusion equation that consolidation amounts to.
#pragma once

#include "support/scene.hpp"
#include "verification/support/fields.hpp"

#include <cmath>
#include <cstdio>

namespace pulmo::test::column {

/// Yoshihara's law (CM4) in uniaxial strain: I1 = J^2 + 2, I3 = J^2, so W' = 2 c J - 2 c J^(-2 beta - 1).
/// Written from the published W (Table 1 of Aviles-Rojas & Hurtado 2022), not from pulmo's stress.
constexpr double c = 1.298, beta = 0.75; // kPa, -
inline double W1(double J)
{
  return 2 * c * (J - std::pow(J, -2 * beta - 1));
}
inline double W2(double J)
{
  return 2 * c * (1 + (2 * beta + 1) * std::pow(J, -2 * beta - 2));
}
inline double W3(double J)
{
  return -2 * c * (2 * beta + 1) * (2 * beta + 2) * std::pow(J, -2 * beta - 3);
}

/// J with W'(J) = stress.
inline double J_of_stress(double stress)
{
  double J = 1;
  for (int i = 0; i < 60; ++i) J -= (W1(J) - stress) / W2(J);
  return J;
}

/// k(J) = c J / W''(J): makes dJ/dt = c d2J/dX2.
struct DiffusivePermeability {
  static constexpr const char *name = "diffusive", *about = "k = c J / W''(J)";
  struct Parameters {
    static constexpr const char *owner = "permeability";
    PetscScalar diffusivity = 1; ///< c, mm^2/s
  };
  static PetscErrorCode declare(Options &options, Parameters &p)
  {
    PetscFunctionBeginUser;
    PetscCall(options.real("diffusivity", "mm^2/s", Range::positive(), "c of k = c J / W''(J)", p.diffusivity));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  static PermeabilityValue permeability(PetscScalar J, const Parameters &p)
  {
    const double w = W2(J);
    return {p.diffusivity * J / w, p.diffusivity * (1 / w - J * W3(J) / (w * w))};
  }
};

/// What is left of a unit step after time @p t of s_t = diffusivity s_XX, s(X, 0) = 1, s_X(0) = 0, s(1) = 0:
///   s = (4/pi) sum (-1)^m/(2m+1) cos((2m+1) pi X/2) d_m.
/// @p steps = 0: d_m = exp(-lambda_m t), the exact solution. Otherwise d_m = (1 + lambda_m t/steps)^-steps, the exact
/// solution of as many backward Euler steps: what a scheme without space error computes.
inline double decay(int m, double t, int steps)
{
  const double root = (2 * m + 1) * M_PI / 2, lambda = root * root;
  return steps == 0 ? std::exp(-lambda * t) : std::pow(1 + lambda * t / steps, -steps);
}
inline double remainder(double X, double t, int steps = 0)
{
  double s = 0;
  for (int m = 0; m < 20000; ++m)
    s += (m % 2 == 0 ? 1 : -1) * std::cos((2 * m + 1) * M_PI * X / 2) * decay(m, t, steps) / (2 * m + 1);
  return 4 / M_PI * s;
}
/// Its integral over the column.
inline double mean_remainder(double t, int steps = 0)
{
  double s = 0;
  for (int m = 0; m < 20000; ++m) s += decay(m, t, steps) / ((2 * m + 1.0) * (2 * m + 1.0));
  return 8 / (M_PI * M_PI) * s;
}

/// A number as an option's value.
inline std::string number(double v)
{
  char text[40];
  std::snprintf(text, sizeof(text), "%.17g", v);
  return text;
}

/// Rollers on x0 and the sides, open at x1, Newton driven to rounding error.
inline std::string options(const std::string &more)
{
  return "-options_file " + source("petsc_options/solvers/tight.opts") + " -dm_plex_filename " +
         source("meshes/column.msh") +
         " -tissue yoshihara -support -support_surfaces x0,sides_y,sides_z -support_components_x0 x"
         " -support_components_sides_y y -support_components_sides_z z -airflow -airflow_surfaces x1 " +
         more;
}

/// Means over the nodes of the sealed end X = 0 and of the open end X = L.
struct Ends {
  double J0 = 0, p0 = 0, u1 = 0;
  double max_p = -1e300, min_p = 1e300; ///< over all vertices
};

inline PetscErrorCode read_ends(DM dm, Vec local, Ends &e)
{
  int n0 = 0, n1 = 0;
  PetscFunctionBeginUser;
  e = Ends();
  PetscCall(sample_corners(dm, local, [&](const Sample &s) {
    e.max_p = std::max(e.max_p, s.p);
    e.min_p = std::min(e.min_p, s.p);
    if (s.x[0] < 1e-9) {
      e.J0 += s.J();
      e.p0 += s.p;
      ++n0;
    } else if (s.x[0] > 1 - 1e-9) {
      e.u1 += s.u[0];
      ++n1;
    }
  }));
  e.J0 /= n0;
  e.p0 /= n0;
  e.u1 /= n1;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo::test::column
