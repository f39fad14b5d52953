// Distances from triangles on a grid, and the spline through them.
#include "pulmo/mesh/signed_distance.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>

namespace pulmo {

namespace {

using Place = ClosedSurface::Place;

/// Nodes that are nearer to a triangle than so many spacings are asked for it at once; the others learn of triangles
/// from their neighbours.
constexpr double band = 1.5;
/// Rounds of eight sweeps that carry triangles over the grid.
constexpr int rounds = 2;

Place operator-(const Place &a, const Place &b)
{
  return {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
}
Place along(const Place &a, const Place &b, double s)
{
  return {a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]};
}
double dot(const Place &a, const Place &b)
{
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
Place cross(const Place &a, const Place &b)
{
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}
Place unit(const Place &a)
{
  const double size = std::sqrt(dot(a, a));
  return size > 0 ? Place{a[0] / size, a[1] / size, a[2] / size} : a;
}

/// A triangle with the outward normals of its parts: corners 0 to 2, edges from corner i to the next 3 + i, face 6
/// (Baerentzen & Aanaes 2005: with these the nearest point tells inside from outside).
struct Facet {
  Place corner[3], normal[7];

  /// The point nearest to @p x, and on which part it is (Ericson 2004, section 5.1.5).
  Place nearest(const Place &x, int &part) const
  {
    const Place &a = corner[0], &b = corner[1], &c = corner[2];
    const Place ab = b - a, ac = c - a, ax = x - a, bx = x - b, cx = x - c;
    const double d1 = dot(ab, ax), d2 = dot(ac, ax), d3 = dot(ab, bx), d4 = dot(ac, bx), d5 = dot(ab, cx),
                 d6 = dot(ac, cx);
    if (d1 <= 0 && d2 <= 0) return part = 0, a;
    if (d3 >= 0 && d4 <= d3) return part = 1, b;
    const double vc = d1 * d4 - d3 * d2, vb = d5 * d2 - d1 * d6, va = d3 * d6 - d5 * d4;
    if (vc <= 0 && d1 >= 0 && d3 <= 0) return part = 3, along(a, ab, d1 / (d1 - d3));
    if (d6 >= 0 && d5 <= d6) return part = 2, c;
    if (vb <= 0 && d2 >= 0 && d6 <= 0) return part = 5, along(a, ac, d2 / (d2 - d6));
    if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) return part = 4, along(b, c - b, (d4 - d3) / (d4 - d3 + d5 - d6));
    const double sum = va + vb + vc;
    return part = 6, along(along(a, ab, vb / sum), ac, vc / sum);
  }
};

std::vector<Facet> facets_of(const ClosedSurface &surface)
{
  std::vector<Facet> list;
  std::vector<Place> at_node(surface.nodes.size(), Place{});
  std::map<std::pair<int, int>, Place> at_edge;

  for (const auto &t : surface.triangles) {
    Facet f;
    for (int i = 0; i < 3; ++i) f.corner[i] = surface.nodes[t[i]];
    f.normal[6] = unit(cross(f.corner[1] - f.corner[0], f.corner[2] - f.corner[0]));
    for (int i = 0; i < 3; ++i) {
      const int next = (i + 1) % 3;
      const Place there = unit(f.corner[next] - f.corner[i]), back = unit(f.corner[(i + 2) % 3] - f.corner[i]);
      const double angle = std::acos(std::clamp(dot(there, back), -1., 1.));
      at_node[t[i]] = along(at_node[t[i]], f.normal[6], angle);
      Place &edge = at_edge.insert({std::minmax(t[i], t[next]), Place{}}).first->second;
      edge = along(edge, f.normal[6], 1);
    }
    list.push_back(f);
  }
  for (std::size_t k = 0; k < list.size(); ++k)
    for (int i = 0; i < 3; ++i) {
      const auto &t = surface.triangles[k];
      list[k].normal[i] = at_node[t[i]];
      list[k].normal[3 + i] = at_edge[std::minmax(t[i], t[(i + 1) % 3])];
    }
  return list;
}

/// The number of nodes along each axis, and the first one.
struct Layout {
  Place origin;
  double n[3];
};

Layout layout(const ClosedSurface &surface, double spacing, double reach)
{
  const Place low = surface.lowest(), high = surface.highest();
  Layout l{};
  for (int d = 0; d < 3; ++d) {
    l.n[d] = 2 + std::ceil((high[d] - low[d] + 2 * reach) / spacing);
    l.origin[d] = (low[d] + high[d]) / 2 - (l.n[d] - 1) / 2 * spacing;
  }
  return l;
}

} // namespace

double SignedDistance::nodes(const ClosedSurface &surface, double spacing, double reach)
{
  const Layout l = layout(surface, spacing, reach);
  return l.n[0] * l.n[1] * l.n[2];
}

void SignedDistance::build(const ClosedSurface &surface, double spacing, double reach)
{
  const std::vector<Facet> facets = facets_of(surface);
  const Layout l = layout(surface, spacing, reach);
  const double far = std::numeric_limits<double>::max();

  spacing_ = spacing;
  origin_ = l.origin;
  for (int d = 0; d < 3; ++d) n_[d] = static_cast<int>(l.n[d]);
  const std::size_t n = static_cast<std::size_t>(n_[0]) * n_[1] * n_[2];
  std::vector<double> &distance = coefficients_;
  std::vector<int> nearest(n, -1);
  distance.assign(n, far); // its size first, then with its sign
  std::vector<signed char> sign(n, 1);
  const auto node = [&](const std::array<int, 3> &i) {
    return Place{origin_[0] + spacing * i[0], origin_[1] + spacing * i[1], origin_[2] + spacing * i[2]};
  };

  // around each triangle
  for (std::size_t k = 0; k < facets.size(); ++k) {
    const Facet &f = facets[k];
    std::array<int, 3> from{}, to{};
    for (int d = 0; d < 3; ++d) {
      const auto [low, high] = std::minmax({f.corner[0][d], f.corner[1][d], f.corner[2][d]});
      from[d] = std::max(0, static_cast<int>(std::ceil((low - origin_[d]) / spacing - band)));
      to[d] = std::min(n_[d] - 1, static_cast<int>(std::floor((high - origin_[d]) / spacing + band)));
    }
    for (int k2 = from[2]; k2 <= to[2]; ++k2)
      for (int k1 = from[1]; k1 <= to[1]; ++k1)
        for (int k0 = from[0]; k0 <= to[0]; ++k0) {
          const std::array<int, 3> i{k0, k1, k2};
          const Place x = node(i);
          if (std::abs(dot(x - f.corner[0], f.normal[6])) > band * spacing) continue;
          int part;
          const Place apart = x - f.nearest(x, part);
          const double size = std::sqrt(dot(apart, apart));
          double &known = distance[index(i)];
          if (size > band * spacing || size >= known) continue;
          known = size;
          nearest[index(i)] = static_cast<int>(k);
          sign[index(i)] = dot(apart, f.normal[part]) > 0 ? -1 : 1;
        }
  }

  // to all other nodes: neighbours out there are on one side of the surface
  const std::vector<int> seeds = nearest;
  for (int sweep = 0; sweep < 8 * rounds; ++sweep) {
    const int step[3] = {sweep & 1 ? -1 : 1, sweep & 2 ? -1 : 1, sweep & 4 ? -1 : 1};
    const auto first = [&](int d) { return step[d] > 0 ? 0 : n_[d] - 1; };
    const auto inside = [&](int i, int d) { return i >= 0 && i < n_[d]; };
    for (int k2 = first(2); inside(k2, 2); k2 += step[2])
      for (int k1 = first(1); inside(k1, 1); k1 += step[1])
        for (int k0 = first(0); inside(k0, 0); k0 += step[0]) {
          const std::array<int, 3> i{k0, k1, k2};
          const std::size_t here = index(i);
          if (seeds[here] >= 0) continue;
          int tried[3] = {-1, -1, -1};
          for (int d = 0; d < 3; ++d) {
            std::array<int, 3> before = i;
            before[d] -= step[d];
            if (!inside(before[d], d)) continue;
            const std::size_t there = index(before);
            const int candidate = nearest[there];
            if (candidate < 0 || candidate == nearest[here] || candidate == tried[0] || candidate == tried[1]) continue;
            tried[d] = candidate;
            int part;
            const Place x = node(i), apart = x - facets[candidate].nearest(x, part);
            const double size = std::sqrt(dot(apart, apart));
            if (size >= distance[here]) continue;
            distance[here] = size;
            nearest[here] = candidate;
            sign[here] = sign[there];
          }
        }
  }

  // a neighbour's triangle may be beside the nearest one: from there on over the surface, as long as it comes nearer
  std::vector<std::vector<int>> around(surface.nodes.size());
  for (std::size_t k = 0; k < facets.size(); ++k)
    for (const int corner : surface.triangles[k]) around[corner].push_back(static_cast<int>(k));
  for (int k2 = 0; k2 < n_[2]; ++k2)
    for (int k1 = 0; k1 < n_[1]; ++k1)
      for (int k0 = 0; k0 < n_[0]; ++k0) {
        const std::size_t here = index({k0, k1, k2});
        if (seeds[here] >= 0 || distance[here] > reach) continue;
        const Place x = node({k0, k1, k2});
        for (int from = -1; from != nearest[here];) {
          from = nearest[here];
          for (const int corner : surface.triangles[from])
            for (const int candidate : around[corner]) {
              int part;
              const Place apart = x - facets[candidate].nearest(x, part);
              const double size = std::sqrt(dot(apart, apart));
              if (size >= distance[here]) continue;
              distance[here] = size;
              nearest[here] = candidate;
            }
        }
      }
  for (std::size_t i = 0; i < n; ++i) distance[i] *= sign[i];

  // c = (1 - delta^2 / 6) s along each axis in turn
  std::size_t stride = 1;
  for (int d = 0; d < 3; ++d) {
    std::vector<double> line(static_cast<std::size_t>(n_[d]));
    const auto length = static_cast<std::size_t>(n_[d]);
    for (std::size_t start = 0; start < n; ++start) {
      if ((start / stride) % length != 0) continue;
      for (std::size_t j = 0; j < length; ++j) line[j] = coefficients_[start + j * stride];
      for (std::size_t j = 1; j + 1 < length; ++j)
        coefficients_[start + j * stride] = line[j] - (line[j - 1] - 2 * line[j] + line[j + 1]) / 6;
    }
    stride *= length;
  }
}

double SignedDistance::departure(const ClosedSurface &surface) const
{
  double sum = 0, total = 0;

  for (const auto &t : surface.triangles) {
    const Place &a = surface.nodes[t[0]], &b = surface.nodes[t[1]], &c = surface.nodes[t[2]];
    const Place normal = cross(b - a, c - a), middle = along(along(a, b - a, 1. / 3), c - a, 1. / 3);
    const double area = std::sqrt(dot(normal, normal)), off = distance(middle.data());
    sum += area * off * off;
    total += area;
  }
  return std::sqrt(sum / total);
}

SignedDistance::Stencil SignedDistance::stencil(const double x[3]) const
{
  Stencil s;
  std::array<int, 3> first{};
  double square = 0;

  for (int d = 0; d < 3; ++d) {
    // the spline reaches from the second node to the last but one; what is no number comes to its begin
    const double place = (x[d] - origin_[d]) / spacing_, least = 1, most = n_[d] - 2,
                 at = place > least ? std::min(place, most) : least;
    const int cell = std::min(static_cast<int>(at), n_[d] - 3);
    const double t = at - cell, r = 1 - t, h = spacing_;
    first[d] = cell - 1;
    s.beyond[d] = (place - at) * h;
    square += s.beyond[d] * s.beyond[d];
    s.weight[d][0] = r * r * r / 6;
    s.weight[d][1] = (4 - 3 * t * t * (2 - t)) / 6;
    s.weight[d][2] = (4 - 3 * r * r * (2 - r)) / 6;
    s.weight[d][3] = t * t * t / 6;
    s.slope[d][0] = -r * r / (2 * h);
    s.slope[d][1] = t * (3 * t - 4) / (2 * h);
    s.slope[d][2] = -r * (3 * r - 4) / (2 * h);
    s.slope[d][3] = t * t / (2 * h);
    s.bend[d][0] = r / (h * h);
    s.bend[d][1] = (3 * t - 2) / (h * h);
    s.bend[d][2] = (3 * r - 2) / (h * h);
    s.bend[d][3] = t / (h * h);
  }
  s.first = index(first);
  s.way = std::sqrt(square);
  return s;
}

double SignedDistance::distance(const double x[3]) const
{
  const Stencil s = stencil(x);
  double sum = 0;

  for (int k = 0; k < 4; ++k)
    for (int j = 0; j < 4; ++j) {
      const double *c = &coefficients_[s.first + n_[0] * (j + static_cast<std::size_t>(n_[1]) * k)];
      double line = 0;
      for (int i = 0; i < 4; ++i) line += s.weight[0][i] * c[i];
      sum += s.weight[1][j] * s.weight[2][k] * line;
    }
  return sum - s.way;
}

SignedDistance::Value SignedDistance::at(const double x[3]) const
{
  const Stencil s = stencil(x);
  Value v;
  double xx = 0, yy = 0, zz = 0, xy = 0, xz = 0, yz = 0;

  for (int k = 0; k < 4; ++k)
    for (int j = 0; j < 4; ++j) {
      const double *c = &coefficients_[s.first + n_[0] * (j + static_cast<std::size_t>(n_[1]) * k)];
      double line = 0, slope = 0, bend = 0;
      for (int i = 0; i < 4; ++i) {
        line += s.weight[0][i] * c[i];
        slope += s.slope[0][i] * c[i];
        bend += s.bend[0][i] * c[i];
      }
      const double wy = s.weight[1][j], wz = s.weight[2][k], sy = s.slope[1][j], sz = s.slope[2][k];
      v.distance += wy * wz * line;
      v.gradient[0] += wy * wz * slope;
      v.gradient[1] += sy * wz * line;
      v.gradient[2] += wy * sz * line;
      xx += wy * wz * bend;
      yy += s.bend[1][j] * wz * line;
      zz += wy * s.bend[2][k] * line;
      xy += sy * wz * slope;
      xz += wy * sz * slope;
      yz += sy * sz * line;
    }
  const double curvature[9] = {xx, xy, xz, xy, yy, yz, xz, yz, zz};
  std::copy_n(curvature, 9, v.curvature);
  if (s.way == 0) return v;
  // beyond the grid: the spline changes along the axes only in which the point is within it
  v.distance -= s.way;
  for (int i = 0; i < 3; ++i) {
    if (s.beyond[i] != 0) v.gradient[i] = 0;
    for (int j = 0; j < 3; ++j) {
      if (s.beyond[i] != 0 || s.beyond[j] != 0) v.curvature[3 * i + j] = 0;
      const bool both = s.beyond[i] != 0 && s.beyond[j] != 0;
      if (both) v.curvature[3 * i + j] -= ((i == j) - s.beyond[i] * s.beyond[j] / (s.way * s.way)) / s.way;
    }
    v.gradient[i] -= s.beyond[i] / s.way;
  }
  return v;
}

} // namespace pulmo
