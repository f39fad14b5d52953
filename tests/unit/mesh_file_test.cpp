// Blocks that meet: what is joined, what is torn, and what is meant to be apart.
#include "pulmo/mesh/mesh_file.hpp"
#include "pulmo/mesh/touching_faces.hpp"

#include <algorithm>
#include <cmath>
#include <functional>
#include <gtest/gtest.h>
#include <map>
#include <numeric>
#include <random>

namespace pulmo::test {
namespace {

using Point = std::array<double, 3>;
using Divisions = std::array<int, 3>;

/// Six tetrahedra in each brick of a block. Each block has nodes of its own.
class Blocks {
public:
  Blocks() { file.groups = {{2, 1, "a"}, {2, 2, "b"}}; }

  void add(const Point &low, const Point &high, const Divisions &n)
  {
    const int first = static_cast<int>(file.nodes.size());
    const auto node = [&](int i, int j, int k) { return first + (i * (n[1] + 1) + j) * (n[2] + 1) + k; };
    for (int i = 0; i <= n[0]; ++i)
      for (int j = 0; j <= n[1]; ++j)
        for (int k = 0; k <= n[2]; ++k) {
          const std::array<int, 3> at{i, j, k};
          Point x;
          for (int d = 0; d < 3; ++d) x[d] = low[d] + (high[d] - low[d]) * at[d] / n[d];
          file.nodes.push_back(x);
        }
    for (int i = 0; i < n[0]; ++i)
      for (int j = 0; j < n[1]; ++j)
        for (int k = 0; k < n[2]; ++k) {
          std::array<int, 3> axes{0, 1, 2};
          do {
            std::array<int, 3> at{i, j, k};
            MeshFile::Element<4> cell{static_cast<long>(file.cells.size()) + 1, -1, {node(i, j, k)}};
            for (int c = 0; c < 3; ++c) {
              ++at[axes[c]];
              cell.nodes[c + 1] = node(at[0], at[1], at[2]);
            }
            file.cells.push_back(cell);
          } while (std::next_permutation(axes.begin(), axes.end()));
        }
  }

  /// Names faces all of whose nodes fulfil @p on.
  void name(int group, const std::function<bool(const Point &, int)> &on)
  {
    std::map<std::array<int, 3>, int> times;
    for (const auto &cell : file.cells)
      for (int out = 0; out < 4; ++out) {
        std::array<int, 3> face;
        for (int i = 0, n = 0; i < 4; ++i)
          if (i != out) face[n++] = cell.nodes[i];
        std::sort(face.begin(), face.end());
        ++times[face];
      }
    for (const auto &[face, n] : times)
      if (n == 1 && std::all_of(face.begin(), face.end(), [&](int i) { return on(file.nodes[i], i); }))
        file.facets.push_back({static_cast<long>(file.facets.size()) + 1, group, face});
  }

  void number()
  {
    file.node_tags.resize(file.nodes.size());
    std::iota(file.node_tags.begin(), file.node_tags.end(), 1);
  }

  void shuffle(unsigned seed)
  {
    std::mt19937 random(seed);
    const std::vector<Point> old = file.nodes;
    std::vector<int> order(old.size());
    std::iota(order.begin(), order.end(), 0);
    std::shuffle(order.begin(), order.end(), random);
    for (std::size_t i = 0; i < old.size(); ++i) file.nodes[order[i]] = old[i];
    for (auto &cell : file.cells) {
      for (int &i : cell.nodes) i = order[i];
      std::shuffle(cell.nodes.begin(), cell.nodes.end(), random);
    }
    for (auto &facet : file.facets)
      for (int &i : facet.nodes) i = order[i];
    std::shuffle(file.cells.begin(), file.cells.end(), random);
  }

  std::string fault(double scale = 1)
  {
    std::string text = make_named_mesh(file, {}, scale, mesh);
    return text;
  }
  std::string notes() const
  {
    std::string all;
    for (const std::string &note : mesh.notes)
      if (note.find("left-handed") == std::string::npos) all += note + "\n"; // half of the cells here
    return all;
  }

  MeshFile file;
  NamedMesh mesh;
};

/// Two blocks of @p size, the second one @p gap to the right of the first.
Blocks two_blocks(double size, double gap, const Divisions &left = {2, 2, 2}, const Divisions &right = {2, 2, 2})
{
  Blocks blocks;
  blocks.add({0, 0, 0}, {size, size, size}, left);
  blocks.add({size + gap, 0, 0}, {2 * size + gap, size, size}, right);
  return blocks;
}

bool says(const std::string &text, const std::string &part)
{
  return text.find(part) != std::string::npos;
}

TEST(Torn, NearlyCoincidentNodesAreRefused)
{
  for (const double size : {2.0, 20.0})
    for (const double gap : {0.0, 1e-12, 1e-9, 1e-6, 1e-4, -1e-12, -1e-6, -1e-4})
      for (const double scale : {1e-3, 1.0, 1e3}) {
        Blocks blocks = two_blocks(size / scale, gap / scale);
        const std::string text = blocks.fault(scale);
        EXPECT_TRUE(says(text, "is torn: 16 faces (" + std::string(size == 2 ? "4" : "400") + " mm^2)")) << gap << text;
        EXPECT_TRUE(says(text, "Coherence Mesh")) << text;
        EXPECT_EQ(says(text, "Geometry.Tolerance"), gap != 0) << text;
        EXPECT_FALSE(says(text, "where nodes")) << text; // there are no numbers
      }
}

TEST(Torn, TheMessageNamesNodesAndDistance)
{
  Blocks blocks = two_blocks(2, 2e-5);
  blocks.number();
  const std::string text = blocks.fault();
  EXPECT_TRUE(says(text, "nodes up to 2e-05 mm apart")) << text;
  EXPECT_TRUE(says(text, "the first at (2, ")) << text;
  const auto at = text.find("where nodes ");
  ASSERT_NE(at, std::string::npos) << text;
  int first = 0, second = 0;
  ASSERT_EQ(std::sscanf(text.c_str() + at, "where nodes %d and %d", &first, &second), 2);
  const Point &a = blocks.file.nodes[first - 1], &b = blocks.file.nodes[second - 1];
  EXPECT_NEAR(std::hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]), 2e-5, 1e-14);
}

TEST(Torn, WhateverTheOrderOfNodes)
{
  const std::string text = two_blocks(2, 1e-6).fault();
  for (unsigned seed = 0; seed < 20; ++seed) {
    Blocks blocks = two_blocks(2, 1e-6);
    blocks.shuffle(seed);
    EXPECT_EQ(blocks.fault(), text);
  }
}

TEST(Torn, WhateverTheNodesMissEachOtherBy)
{
  for (unsigned seed = 0; seed < 20; ++seed) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> noise(-1e-5, 1e-5);
    Blocks blocks = two_blocks(2, 0);
    for (Point &x : blocks.file.nodes)
      for (double &component : x) component += noise(random);
    EXPECT_TRUE(says(blocks.fault(), "is torn: 16 faces")) << blocks.fault();
  }
}

/// The smallest crack: one inner node is there twice, and the cells on its left have the other one.
TEST(Torn, ASingleNode)
{
  for (const double gap : {0.0, 1e-5}) {
    Blocks blocks;
    blocks.add({0, 0, 0}, {2, 2, 2}, {2, 2, 2});
    const int inner = 13, twin = static_cast<int>(blocks.file.nodes.size());
    blocks.file.nodes.push_back({1 - gap, 1, 1});
    for (auto &cell : blocks.file.cells) {
      double x = 0;
      for (const int i : cell.nodes) x += blocks.file.nodes[i][0] / 4;
      for (int &i : cell.nodes)
        if (i == inner && x < 1) i = twin;
    }
    EXPECT_TRUE(says(blocks.fault(), "is torn: 12 faces (3 mm^2)")) << blocks.fault();
  }
}

TEST(Torn, OtherNodesOnEitherSide)
{
  for (const Divisions &right : {Divisions{2, 3, 3}, Divisions{1, 7, 5}, Divisions{4, 1, 1}})
    for (const double gap : {0.0, 1e-7, -1e-7}) {
      Blocks blocks = two_blocks(2, gap, {2, 2, 2}, right);
      EXPECT_TRUE(says(blocks.fault(), "has parts that meet without being joined: ")) << blocks.fault();
      EXPECT_TRUE(says(blocks.fault(), "the first at (2, ")) << blocks.fault();
    }
  Blocks blocks; // turned in its plane, and smaller than its neighbour
  blocks.add({0, 0, 0}, {2, 2, 2}, {1, 1, 1});
  const std::size_t n = blocks.file.nodes.size();
  blocks.add({2, 0.5, 0.5}, {3, 1.5, 1.5}, {2, 2, 2});
  for (std::size_t i = n; i < blocks.file.nodes.size(); ++i) {
    Point &x = blocks.file.nodes[i];
    const double y = x[1] - 1, z = x[2] - 1;
    x[1] = 1 + 0.6 * y - 0.8 * z;
    x[2] = 1 + 0.8 * y + 0.6 * z;
  }
  EXPECT_TRUE(says(blocks.fault(), "has parts that meet without being joined: ")) << blocks.fault();
}

TEST(Torn, HangingNodes)
{
  Blocks blocks; // the coarse side's corners are nodes of both
  blocks.add({0, 0, 0}, {2, 2, 2}, {1, 1, 1});
  const std::size_t n = blocks.file.nodes.size();
  blocks.add({2, 0, 0}, {4, 2, 2}, {2, 2, 2});
  for (auto &cell : blocks.file.cells)
    for (int &i : cell.nodes)
      for (std::size_t j = 0; j < n; ++j)
        if (blocks.file.nodes[i] == blocks.file.nodes[j]) i = static_cast<int>(j);
  EXPECT_TRUE(says(blocks.fault(), "has parts that meet without being joined: 10 faces (4 mm^2)")) << blocks.fault();
}

TEST(Torn, PartsThatOverlap)
{
  for (const double gap : {0.0, 1e-7}) {
    Blocks blocks;
    blocks.add({0, 0, 0}, {2, 2, 2}, {2, 2, 2});
    blocks.add({gap, 0, 0}, {2 + gap, 2, 2}, {2, 2, 2});
    blocks.name(0, [](const Point &, int) { return true; }); // names are no excuse
    EXPECT_TRUE(says(blocks.fault(), "has parts that overlap: 96 faces (24 mm^2)")) << blocks.fault();
  }
}

TEST(Apart, SlitsThatAreNamedOnBothSides)
{
  for (const double gap : {0.0, 1e-6}) {
    Blocks blocks = two_blocks(2, gap);
    const int n = static_cast<int>(blocks.file.nodes.size()) / 2;
    blocks.name(0, [&](const Point &x, int i) { return i < n && x[0] > 1.99; });
    EXPECT_TRUE(says(blocks.fault(), "is torn")) << blocks.fault(); // one side only
    blocks.name(1, [&](const Point &x, int i) { return i >= n && x[0] < 2.01; });
    EXPECT_EQ(blocks.fault(), "");
    EXPECT_TRUE(says(blocks.notes(), "16 faces (4 mm^2) of 'a' and 'b'")) << blocks.notes();
    EXPECT_TRUE(says(blocks.notes(), "taken for a slit")) << blocks.notes();
  }
}

TEST(Apart, Fissures)
{
  Blocks wide = two_blocks(6, 0.1); // edges of 3 mm
  EXPECT_EQ(wide.fault(), "");
  EXPECT_EQ(wide.notes(), "");
  Blocks narrow = two_blocks(6, 0.03);
  EXPECT_EQ(narrow.fault(), "");
  EXPECT_TRUE(says(narrow.notes(), "16 faces (36 mm^2)")) << narrow.notes();
  EXPECT_TRUE(says(narrow.notes(), "are at most 0.03 mm from others")) << narrow.notes();
  narrow.name(0, [](const Point &, int) { return true; });
  EXPECT_EQ(narrow.fault(), "");
  EXPECT_EQ(narrow.notes(), "");
}

/// However thin a wall is, it is no crack.
TEST(Apart, ThinLayers)
{
  for (const double thickness : {1e-2, 1e-4, 1e-7})
    for (const int layers : {1, 3}) {
      Blocks blocks;
      blocks.add({0, 0, 0}, {2, 2, thickness}, {2, 2, layers});
      EXPECT_EQ(blocks.fault(), "");
      EXPECT_EQ(blocks.notes(), "");
    }
}

TEST(Apart, BlocksThatShareAnEdgeOrVertex)
{
  for (const Point &low : {Point{2, 2, 0}, Point{2, 2, 2}, Point{2, 2 - 1e-9, 2}}) {
    Blocks blocks;
    blocks.add({0, 0, 0}, {2, 2, 2}, {2, 2, 2});
    blocks.add(low, {low[0] + 2, low[1] + 2, low[2] + 2}, {2, 2, 2});
    EXPECT_EQ(blocks.fault(), "");
    EXPECT_EQ(blocks.notes(), "");
  }
}

/// Sharp edges of a lung: two surfaces with a few degrees between them.
TEST(Apart, SharpEdges)
{
  for (const double degrees : {1.0, 5.0}) {
    Blocks blocks;
    blocks.add({0, 0, 0}, {4, 4, 4}, {4, 4, 4});
    for (Point &x : blocks.file.nodes) x[2] *= (0.01 + x[0] / 4) * std::tan(degrees * std::acos(-1) / 180);
    EXPECT_EQ(blocks.fault(), "");
    EXPECT_EQ(blocks.notes(), "");
  }
}

/// Fine and coarse faces side by side: as many as they are, the search takes the time of a sort.
TEST(TouchingFaces, OfManySizes)
{
  std::mt19937 random(1);
  std::uniform_real_distribution<double> place(-50, 50), size(-8, 1);
  std::vector<Point> nodes;
  std::vector<BoundaryFace> faces;
  for (int i = 0; i < 20000; ++i) { // pairs, each with a cell of its own
    const Point x{place(random), place(random), place(random)};
    const double h = std::pow(10, size(random)), gap = i % 2 ? 1e-4 * h : 0.1 * h;
    for (const double side : {-1.0, 1.0}) {
      const int first = static_cast<int>(nodes.size());
      nodes.push_back({x[0], x[1], x[2] + (side > 0 ? gap : 0)});
      nodes.push_back({x[0] + h, x[1], x[2] + (side > 0 ? gap : 0)});
      nodes.push_back({x[0], x[1] + h, x[2] + (side > 0 ? gap : 0)});
      nodes.push_back({x[0], x[1], x[2] + side * h});
      faces.push_back({{first, first + 1, first + 2}, first + 3, static_cast<int>(faces.size())});
    }
  }
  const auto touches = touching_faces(nodes, faces, 1e-3);
  int wrong = 0;
  std::size_t n = 0;
  for (const Touch &touch : touches) {
    if (touch.face / 2 == touch.other / 2) {
      ++n;
      if (touch.face / 2 % 2 == 0 || touch.overlaps || !touch.matches) ++wrong;
    }
  }
  EXPECT_EQ(wrong, 0);
  EXPECT_EQ(n, 20000u);
  EXPECT_LT(touches.size(), 20100u); // those that lie there by chance
}

} // namespace
} // namespace pulmo::test
