// Closed surfaces: STL files, holes and turned triangles, the signed distance and its derivatives.
#include "support/scene.hpp"
#include "unit/tensors.hpp"

#include "pulmo/mesh/closed_surface.hpp"
#include "pulmo/mesh/signed_distance.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <functional>
#include <sstream>

namespace pulmo::test {
namespace {

using Place = ClosedSurface::Place;
using List = std::vector<ClosedSurface::Corners>;

/// An octahedron, each triangle in four @p refine times, its nodes moved by @p place (of a unit vector).
List ball(int refine, const std::function<Place(const Place &)> &place)
{
  List list;
  for (int octant = 0; octant < 8; ++octant) {
    const double s[3] = {octant & 1 ? -1. : 1., octant & 2 ? -1. : 1., octant & 4 ? -1. : 1.};
    list.push_back({Place{s[0], 0, 0}, Place{0, s[1], 0}, Place{0, 0, s[2]}});
    if (s[0] * s[1] * s[2] < 0) std::swap(list.back()[1], list.back()[2]);
  }
  const auto middle = [](const Place &a, const Place &b) {
    Place m{a[0] + b[0], a[1] + b[1], a[2] + b[2]};
    const double size = std::hypot(m[0], m[1], m[2]);
    for (double &x : m) x /= size;
    return m;
  };
  for (; refine > 0; --refine) {
    List finer;
    for (const auto &[a, b, c] : list) {
      const Place ab = middle(a, b), bc = middle(b, c), ca = middle(c, a);
      for (const ClosedSurface::Corners &t :
           {ClosedSurface::Corners{a, ab, ca}, {ab, b, bc}, {ca, bc, c}, {ab, bc, ca}})
        finer.push_back(t);
    }
    list = finer;
  }
  for (auto &t : list)
    for (Place &x : t) x = place(x);
  return list;
}

List sphere(double radius, int refine)
{
  return ball(refine, [radius](const Place &n) { return Place{radius * n[0], radius * n[1], radius * n[2]}; });
}

List box(const Place &size)
{
  List list;
  const auto corner = [&](int i) { return Place{i & 1 ? size[0] : 0, i & 2 ? size[1] : 0, i & 4 ? size[2] : 0}; };
  for (const auto &[a, b, c, d] :
       {std::array<int, 4>{0, 2, 3, 1}, {4, 5, 7, 6}, {0, 1, 5, 4}, {2, 6, 7, 3}, {0, 4, 6, 2}, {1, 3, 7, 5}}) {
    list.push_back({corner(a), corner(b), corner(c)});
    list.push_back({corner(a), corner(c), corner(d)});
  }
  return list;
}

std::string ascii(const List &list)
{
  std::ostringstream s;
  s << "solid of a test\n";
  for (const auto &t : list) {
    s << " facet normal 0 0 0\n  outer loop\n";
    for (const Place &x : t) s << "   VERTEX " << x[0] << " " << x[1] << " " << x[2] << "\n";
    s << "  endloop\n endfacet\n";
  }
  s << "endsolid\n";
  return s.str();
}

std::string binary(const List &list)
{
  std::string s(80, ' ');
  s.replace(0, 5, "solid"); // as some programs write
  const auto add = [&s](const auto &value) { s.append(reinterpret_cast<const char *>(&value), sizeof(value)); };
  add(static_cast<std::uint32_t>(list.size()));
  for (const auto &t : list) {
    for (int i = 0; i < 3; ++i) add(0.f);
    for (const Place &x : t)
      for (const double component : x) add(static_cast<float>(component));
    s.append(2, '\0');
  }
  return s;
}

SignedDistance distance_from(const List &list, double spacing, double reach)
{
  ClosedSurface surface;
  SignedDistance s;
  EXPECT_EQ(join_triangles(list, surface), "");
  s.build(surface, spacing, reach);
  return s;
}

TEST(ClosedSurface, ReadsBothKindsOfStl)
{
  const List list = box({2, 3, 4});
  for (const std::string &content : {ascii(list), binary(list)}) {
    List read;
    ClosedSurface surface;
    ASSERT_EQ(read_stl(content, read), "");
    ASSERT_EQ(read.size(), list.size());
    ASSERT_EQ(join_triangles(read, surface), "");
    EXPECT_EQ(surface.nodes.size(), 8u);
    EXPECT_EQ(surface.triangles.size(), 12u);
    EXPECT_EQ(surface.highest(), (Place{2, 3, 4}));
    EXPECT_DOUBLE_EQ(surface.size(), std::sqrt(29.));
  }
}

TEST(ClosedSurface, ReadsStlAsProgramsWriteIt)
{
  const List list = box({2, 3, 4});
  const std::string plain = ascii(list);
  const std::size_t name = plain.find('\n');
  std::string upper = plain, one_line = plain, returns = plain;
  std::transform(upper.begin(), upper.end(), upper.begin(), [](unsigned char c) { return std::toupper(c); });
  std::replace(one_line.begin(), one_line.end(), '\n', ' ');
  one_line.replace(one_line.find("facet"), 5, "facet normal 0 0 1");
  std::replace(returns.begin(), returns.end(), '\n', '\r');
  for (const std::string &content :
       {upper, " \n\t" + plain, "\xef\xbb\xbf" + plain, "solid vertex group" + plain.substr(name),
        "solid facet of vertex 3" + plain.substr(name), "SOLID" + plain.substr(name) + "\nendsolid vertex\n", one_line,
        returns, binary(list) + std::string(3, '\n'), binary(list) + std::string(49, '\0')}) {
    List read;
    EXPECT_EQ(read_stl(content, read), "") << content.substr(0, 40);
    EXPECT_EQ(read, list) << content.substr(0, 40);
  }
  List read;
  EXPECT_NE(read_stl(binary(list) + std::string(50, '\0'), read), "");
}

TEST(ClosedSurface, EachBodyIsTurnedByItself)
{
  const auto moved = [](List list, double by, bool inside_out) {
    for (auto &t : list) {
      for (Place &x : t)
        for (double &component : x) component += by;
      if (inside_out) std::swap(t[0], t[1]);
    }
    return list;
  };
  const auto joined = [](const std::vector<List> &bodies) {
    List list;
    for (const List &body : bodies) list.insert(list.end(), body.begin(), body.end());
    return list;
  };
  const List outer = box({20, 20, 20}), inner = box({8, 8, 8}), core = box({2, 2, 2});
  for (int turned = 0; turned < 8; ++turned) { // whichever is inside out
    const bool first = turned & 1, second = turned & 2, third = turned & 4;
    const SignedDistance apart = distance_from(joined({moved(outer, 0, first), moved(inner, 30, second)}), 0.5, 5);
    for (const Place &x : {Place{10, 10, 10}, {34, 34, 34}}) EXPECT_GT(apart.distance(x.data()), 3);
    if (turned < 4) { // two that cut each other
      const SignedDistance cut = distance_from(joined({moved(outer, 0, first), moved(inner, 15, second)}), 0.5, 5);
      for (const Place &x : {Place{5, 5, 5}, {21.5, 21.5, 21.5}}) EXPECT_GT(cut.distance(x.data()), 1);
    }
    // a body in a hole of another
    const SignedDistance nested =
        distance_from(joined({moved(outer, 0, first), moved(inner, 6, second), moved(core, 9, third)}), 0.5, 5);
    for (const Place &x : {Place{3, 10, 10}, {10, 10, 10}}) EXPECT_GT(nested.distance(x.data()), 0.5);
    for (const Place &x : {Place{7.5, 10, 10}, {-2, 10, 10}}) EXPECT_LT(nested.distance(x.data()), -1);
  }
}

TEST(ClosedSurface, NeitherOrderNorSideShows)
{
  List list = box({2, 3, 4});
  ClosedSurface surface, other;
  ASSERT_EQ(join_triangles(list, surface), "");
  std::reverse(list.begin(), list.end());
  for (auto &t : list) std::rotate(t.begin(), t.begin() + 1, t.end());
  ASSERT_EQ(join_triangles(list, other), "");
  EXPECT_EQ(surface.nodes, other.nodes);
  EXPECT_EQ(surface.triangles, other.triangles);
  for (auto &t : list) std::swap(t[0], t[1]); // inside out
  ASSERT_EQ(join_triangles(list, other), "");
  SignedDistance s;
  s.build(other, 0.5, 2);
  const double middle[3] = {1, 1.5, 2};
  EXPECT_GT(s.distance(middle), 0.5);
}

TEST(ClosedSurface, TellsWhatIsWrong)
{
  const List whole = box({2, 3, 4});
  const auto fault = [](const List &list) {
    ClosedSurface surface;
    return join_triangles(list, surface);
  };
  List list = whole;
  list.pop_back();
  EXPECT_NE(fault(list).find("3 edges of one triangle alone"), std::string::npos);
  list = whole;
  std::swap(list[4][0], list[4][1]);
  EXPECT_NE(fault(list).find("run the same way"), std::string::npos);
  list = whole;
  list.push_back(whole[3]);
  EXPECT_NE(fault(list).find("run the same way"), std::string::npos);
  list = {whole[0], whole[0]};
  std::swap(list[1][1], list[1][2]);
  EXPECT_NE(fault(list).find("no volume"), std::string::npos);
  EXPECT_NE(fault({}).find("no triangles"), std::string::npos);
  for (const char *content : {"", "solid", "facet", "solid\nfacet\nvertex 0 0\nendfacet", "solid\nvertex 0 0 nan",
                              "solid\nfacet\nvertex 0 0 0\nvertex 1 0 0\nendfacet"}) {
    List read;
    EXPECT_NE(read_stl(content, read), "") << content;
  }
  const std::string cut = binary(whole);
  List read;
  EXPECT_NE(read_stl(cut.substr(0, cut.size() - 10), read), "");
}

TEST(SignedDistance, OfPlanesIsExact)
{
  const SignedDistance s = distance_from(box({20, 30, 40}), 1, 4);
  for (const Place &x : {Place{9.7, 14.2, 38.6}, {9.7, 14.2, 41.3}, {8, 15, 40}, {11.1, 16, 43.9}}) {
    const SignedDistance::Value v = s.at(x.data());
    EXPECT_NEAR(v.distance, 40 - x[2], 1e-12);
    EXPECT_NEAR(s.distance(x.data()), v.distance, 1e-12);
    for (int i = 0; i < 3; ++i) EXPECT_NEAR(v.gradient[i], i == 2 ? -1 : 0, 1e-12);
    for (const double c : v.curvature) EXPECT_NEAR(c, 0, 1e-11);
  }
}

TEST(SignedDistance, OfASphere)
{
  constexpr double radius = 10;
  const List list = sphere(radius, 6);
  const SignedDistance s = distance_from(list, 1, 5);
  double within = 0; // the sphere, of the middles of its triangles
  for (const auto &[a, b, c] : list)
    within = std::max(within, radius - std::hypot(a[0] + b[0] + c[0], a[1] + b[1] + c[1], a[2] + b[2] + c[2]) / 3);
  Random random(3);
  for (int n = 0; n < 500; ++n) {
    double x[3], r = 0;
    for (double &component : x) component = random(-1, 1);
    for (const double component : x) r += component * component;
    r = std::sqrt(r);
    const double wanted = random(7, 13);
    for (double &component : x) component *= wanted / r;
    const SignedDistance::Value v = s.at(x);
    EXPECT_NEAR(v.distance, radius - wanted - within / 2, within / 2 + 5e-4);
    for (int i = 0; i < 3; ++i) {
      EXPECT_NEAR(v.gradient[i], -x[i] / wanted, 2e-2);
      for (int j = 0; j < 3; ++j)
        if (std::abs(wanted - radius) > 1) { // nearer the facets show
          EXPECT_NEAR(v.curvature[3 * i + j], -((i == j) - x[i] * x[j] / (wanted * wanted)) / wanted, 2e-2);
        }
    }
  }
}

/// From the nearest point (x_i a_i^2 / (a_i^2 + t)) of an ellipsoid, for a point outside: the largest root t.
double outside_ellipsoid(const Place &a, const double x[3])
{
  const auto level = [&](double t) {
    double sum = -1;
    for (int i = 0; i < 3; ++i) sum += std::pow(a[i] * x[i] / (a[i] * a[i] + t), 2);
    return sum;
  };
  double low = 0, high = 1e4, square = 0;
  for (int k = 0; k < 200; ++k) (level((low + high) / 2) > 0 ? low : high) = (low + high) / 2;
  for (int i = 0; i < 3; ++i) square += std::pow(x[i] * (1 - a[i] * a[i] / (a[i] * a[i] + low)), 2);
  return std::sqrt(square);
}

TEST(SignedDistance, OfAnEllipsoid)
{
  const Place a{8, 10, 14};
  const SignedDistance s = distance_from(ball(6,
                                              [&](const Place &n) {
                                                return Place{a[0] * n[0], a[1] * n[1], a[2] * n[2]};
                                              }),
                                         1, 5);
  Random random(5);
  for (int n = 0; n < 500; ++n) {
    double x[3], level = 0;
    for (double &component : x) component = random(-1, 1);
    for (int i = 0; i < 3; ++i) level += std::pow(x[i] / a[i], 2);
    const double out = random(1, 1.3) / std::sqrt(level);
    for (double &component : x) component *= out;
    EXPECT_NEAR(s.distance(x), -outside_ellipsoid(a, x), 5e-3);
  }
}

TEST(SignedDistance, DerivativesAreThoseOfTheValue)
{
  const SignedDistance s = distance_from(box({6, 7, 8}), 1, 3);
  Random random(7);
  for (int n = 0; n < 300; ++n) {
    double x[3];
    for (double &component : x) component = random(-9, 17); // also far beyond the grid
    const SignedDistance::Value v = s.at(x);
    EXPECT_NEAR(v.distance, s.distance(x), 1e-12);
    for (int j = 0; j < 3; ++j) {
      constexpr double e = 1e-5;
      double right[3] = {x[0], x[1], x[2]}, left[3] = {x[0], x[1], x[2]};
      right[j] += e;
      left[j] -= e;
      const SignedDistance::Value r = s.at(right), l = s.at(left);
      EXPECT_NEAR(v.gradient[j], (r.distance - l.distance) / (2 * e), 1e-8);
      for (int i = 0; i < 3; ++i) EXPECT_NEAR(v.curvature[3 * i + j], (r.gradient[i] - l.gradient[i]) / (2 * e), 1e-4);
    }
  }
}

TEST(SignedDistance, ReachesAllOfTheGrid)
{
  const SignedDistance s = distance_from(sphere(10, 5), 0.7, 30);
  for (const Place &x : {Place{0, 0, 38}, {20, 20, 20}, {-30, 10, -25}, {0.1, 0.2, 9}}) {
    EXPECT_NEAR(s.distance(x.data()), 10 - std::hypot(x[0], x[1], x[2]), 1e-2);
  }
}

} // namespace
} // namespace pulmo::test
