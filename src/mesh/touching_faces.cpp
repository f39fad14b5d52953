#include "pulmo/mesh/touching_faces.hpp"

#include "pulmo/base/space.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <tuple>

namespace pulmo {

namespace {

using Point = SpacePoint;

/// Normals of faces in one plane have at least this cosine: the sides of a badly joined curved surface do, those of an
/// edge do not.
constexpr double one_plane = 0.99;
/// A centre may lie so far outside of a face, in shares of the face, and as far from it in shares of the coordinates.
constexpr double rounding = 1e-12;

/// Boxes of any size, each in the squares of a grid that is a little coarser than the box, so that a fine part of a
/// mesh next to a coarse one costs nothing.
class Boxes {
public:
  void add(const Point &low, const Point &high, int index)
  {
    double size = 0;
    for (int d = 0; d < 3; ++d) size = std::max(size, high[d] - low[d]);
    const int level = std::ilogb(size) + 2; // at least twice the box: most lie in one square or two
    const Point first = square(low, level), last = square(high, level);
    for (const double x : {first[0], last[0]})
      for (const double y : {first[1], last[1]})
        for (const double z : {first[2], last[2]}) entries_.push_back({level, {x, y, z}, index});
  }
  void sort()
  {
    std::sort(entries_.begin(), entries_.end());
    entries_.erase(std::unique(entries_.begin(), entries_.end()), entries_.end());
    for (const Entry &e : entries_)
      if (levels_.empty() || levels_.back() != e.level) levels_.push_back(e.level);
  }
  /// Calls @p visit with each box that may hold the point.
  template <class Visit>
  void around(const Point &x, const Visit &visit) const
  {
    for (const int level : levels_) {
      const Entry from{level, square(x, level), 0};
      for (auto e = std::lower_bound(entries_.begin(), entries_.end(), from);
           e != entries_.end() && e->level == level && e->square == from.square; ++e)
        visit(e->index);
    }
  }

private:
  struct Entry {
    int level;
    Point square;
    int index;
    bool operator<(const Entry &o) const
    {
      return std::tie(level, square, index) < std::tie(o.level, o.square, o.index);
    }
    bool operator==(const Entry &o) const { return level == o.level && square == o.square && index == o.index; }
  };
  static Point square(const Point &x, int level)
  {
    return {std::floor(std::scalbn(x[0], -level)), std::floor(std::scalbn(x[1], -level)),
            std::floor(std::scalbn(x[2], -level))};
  }

  std::vector<Entry> entries_;
  std::vector<int> levels_;
};

struct Shape {
  Point centre{}, normal{}; ///< normal: of length 1, away from the cell
  double area = 0;
  double size = 0; ///< of the cell
};

Shape shape_of(const std::vector<Point> &x, const BoundaryFace &face)
{
  Shape shape;
  const std::array<int, 4> corners{face.nodes[0], face.nodes[1], face.nodes[2], face.opposite};
  double least = std::numeric_limits<double>::infinity();
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < i; ++j) {
      const Point edge = difference(x[corners[i]], x[corners[j]]);
      least = std::min(least, std::sqrt(dot(edge, edge)));
    }
  const Point a = difference(x[corners[1]], x[corners[0]]), b = difference(x[corners[2]], x[corners[0]]),
              up = difference(x[corners[3]], x[corners[0]]), n = cross(a, b);
  const double length = std::sqrt(dot(n, n)), height = dot(n, up) / length;
  for (int d = 0; d < 3; ++d) {
    shape.centre[d] = x[corners[0]][d] + (a[d] + b[d]) / 3;
    shape.normal[d] = n[d] / (height > 0 ? -length : length);
  }
  shape.area = length / 2;
  shape.size = std::min(least, std::abs(height));
  return shape;
}

/// Whether the foot of @p p in the plane of the face lies within it.
bool above(const std::vector<Point> &x, const BoundaryFace &face, const Shape &shape, const Point &p)
{
  const double least = rounding * shape.area;
  bool positive = true, negative = true; // either sense of rotation
  for (int i = 0; i < 3; ++i) {
    const Point &a = x[face.nodes[i]], &b = x[face.nodes[(i + 1) % 3]];
    const double part = dot(shape.normal, cross(difference(b, a), difference(p, a)));
    positive = positive && part > -least;
    negative = negative && part < least;
  }
  return positive || negative;
}

/// Fills in whether the nodes of two faces that touch are the same but for @p distance.
void match(const std::vector<Point> &x, const BoundaryFace &face, const BoundaryFace &other, double distance,
           Touch &touch)
{
  touch.matches = true;
  touch.twins_distance = -1;
  for (const int i : face.nodes) {
    double nearest = std::numeric_limits<double>::infinity();
    int twin = -1;
    for (const int j : other.nodes) {
      const Point d = difference(x[i], x[j]);
      const double away = i == j ? -1 : std::sqrt(dot(d, d)); // a node that both have is no twin
      if (away < nearest) {
        nearest = away;
        twin = j;
      }
    }
    touch.matches = touch.matches && nearest <= distance;
    if (nearest > touch.twins_distance) {
      touch.twins_distance = nearest;
      touch.twins = {i, twin};
    }
  }
}

} // namespace

std::vector<Touch> touching_faces(const std::vector<Point> &nodes, const std::vector<BoundaryFace> &faces, double share)
{
  std::vector<Touch> touches;
  std::vector<Shape> shapes;
  Boxes boxes;
  double largest = 0; // coordinate
  for (const BoundaryFace &face : faces)
    for (const int node : face.nodes)
      for (const double x : nodes[node]) largest = std::max(largest, std::abs(x));
  for (std::size_t i = 0; i < faces.size(); ++i) {
    shapes.push_back(shape_of(nodes, faces[i]));
    Point low = nodes[faces[i].nodes[0]], high = low;
    for (const int node : faces[i].nodes)
      for (int d = 0; d < 3; ++d) {
        low[d] = std::min(low[d], nodes[node][d]);
        high[d] = std::max(high[d], nodes[node][d]);
      }
    const double reach = share * shapes[i].size + rounding * largest;
    for (int d = 0; d < 3; ++d) {
      low[d] -= reach;
      high[d] += reach;
    }
    boxes.add(low, high, static_cast<int>(i));
  }
  boxes.sort();
  for (std::size_t i = 0; i < faces.size(); ++i) {
    const Shape &here = shapes[i];
    double nearest = std::numeric_limits<double>::infinity();
    Touch touch;
    boxes.around(here.centre, [&](int k) {
      const auto j = static_cast<std::size_t>(k);
      if (faces[j].cell == faces[i].cell) return;
      const Shape &there = shapes[j];
      const double cosine = dot(here.normal, there.normal);
      if (std::abs(cosine) < one_plane) return;
      const double distance = std::abs(dot(there.normal, difference(here.centre, nodes[faces[j].nodes[0]]))),
                   size = std::min(here.size, there.size);
      if (distance >= nearest || distance > share * size + rounding * largest ||
          !above(nodes, faces[j], there, here.centre))
        return;
      nearest = distance;
      touch.face = static_cast<int>(i);
      touch.other = k;
      touch.distance = distance;
      touch.share = distance <= rounding * largest ? 0 : distance / size;
      touch.overlaps = cosine > 0;
    });
    if (nearest == std::numeric_limits<double>::infinity()) continue;
    const auto other = static_cast<std::size_t>(touch.other);
    match(nodes, faces[i], faces[other], share * std::min(here.size, shapes[other].size) + rounding * largest, touch);
    touches.push_back(touch);
  }
  return touches;
}

} // namespace pulmo
