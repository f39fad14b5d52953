/// @file
/// Points and directions in space.
#pragma once

#include <array>
#include <cmath>

namespace pulmo {

using SpacePoint = std::array<double, 3>;

inline SpacePoint difference(const SpacePoint &a, const SpacePoint &b)
{
  return {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
}

inline SpacePoint cross(const SpacePoint &a, const SpacePoint &b)
{
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

inline double dot(const SpacePoint &a, const SpacePoint &b)
{
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

inline double length(const SpacePoint &a)
{
  return std::sqrt(dot(a, a));
}

} // namespace pulmo
