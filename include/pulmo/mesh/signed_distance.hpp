/// @file
/// The signed distance from a closed surface as a smooth function of place, with its derivatives.
///
/// The distance to the triangles is computed at the nodes of a grid, and cubic B-splines run through them (a
/// quasi-interpolation of fourth order): the value has two continuous derivatives everywhere. Planes are met to
/// rounding, smooth surfaces to the fourth order in the spacing; edges are rounded off over about a spacing.
#pragma once

#include "pulmo/mesh/closed_surface.hpp"

#include <array>
#include <string>
#include <vector>

namespace pulmo {

class SignedDistance {
public:
  struct Value {
    double distance = 0;   ///< mm, positive inside
    double gradient[3]{};  ///< points inward on the surface
    double curvature[9]{}; ///< second derivatives, 1/mm
  };

  /// Nodes that a grid may have at most: 8 bytes each, on every rank.
  static constexpr double most_nodes = 1.5e8;

  /// Nodes of a grid of @p spacing that reaches @p reach beyond the surface, mm. Not more than most_nodes, or build()
  /// must not be called.
  static double nodes(const ClosedSurface &surface, double spacing, double reach);
  void build(const ClosedSurface &surface, double spacing, double reach);

  /// The mean (root of squares over the area) of what is not zero on @p surface, mm: the middles of its triangles.
  double departure(const ClosedSurface &surface) const;

  /// At @p x, mm. Beyond the grid: what the nearest place of the grid has, less the way there.
  double distance(const double x[3]) const;
  Value at(const double x[3]) const;

private:
  /// The spline's place for a point: its first coefficient, weights, and derivatives of weights by direction.
  struct Stencil {
    std::size_t first;
    double weight[3][4], slope[3][4], bend[3][4];
    double beyond[3], way; ///< of the point from the grid, mm
  };
  Stencil stencil(const double x[3]) const;
  std::size_t index(const std::array<int, 3> &i) const
  {
    return static_cast<std::size_t>(i[0]) +
           static_cast<std::size_t>(n_[0]) * (i[1] + static_cast<std::size_t>(n_[1]) * i[2]);
  }

  double spacing_ = 1;
  std::array<double, 3> origin_{};
  std::array<int, 3> n_{}; ///< nodes along each axis
  std::vector<double> coefficients_;
};

} // namespace pulmo
