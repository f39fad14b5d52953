/// @file
/// Tetrahedral meshes of boxes, quarter cylinders and octants of a ball at any fineness, as MSH 2.2 files that go away
/// with the test.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <string>
#include <unistd.h>
#include <vector>

namespace pulmo::test {

/// The part of a lattice of bricks that a mesh is made of, each brick cut in six (H. W. Kuhn 1960), and where it goes.
class Lattice {
public:
  using Place = std::array<double, 3>; ///< in the lattice, 0 to 1 along each axis

  std::array<int, 3> bricks{1, 1, 1};
  std::function<bool(const Place &)> inside = [](const Place &) { return true; }; ///< which corners belong to it
  std::function<Place(const Place &)> map = [](const Place &x) { return x; };     ///< to coordinates, mm
  /// Name of the boundary triangle whose centre is there.
  std::function<std::string(const Place &)> name = face_of_box;
  /// Name of the volume of the tetrahedron whose centre is there.
  std::function<std::string(const Place &)> part = [](const Place &) { return "body"; };

  static std::string face_of_box(const Place &x)
  {
    for (int d = 0; d < 3; ++d)
      for (int side = 0; side < 2; ++side)
        if (std::abs(x[d] - side) < 1e-9) return std::string(1, "xyz"[d]) + "01"[side];
    return "inside";
  }

  /// 0 <= x <= length[0], ...; surfaces x0, x1, ..., z1.
  static Lattice box(std::array<int, 3> bricks, Place length)
  {
    Lattice l;
    l.bricks = bricks;
    l.map = [length](const Place &x) { return Place{length[0] * x[0], length[1] * x[1], length[2] * x[2]}; };
    return l;
  }
  /// x, y >= 0 of a cylinder of unit radius about z: n cells along the radius and along the arc. Surfaces x0, y0, z0,
  /// z1, side. Flat facets enclose sin(pi/2n)/(pi/2n) of the cylinder: the radius is larger to make up for it.
  static Lattice quarter_cylinder(int n, int layers, double height)
  {
    const double angle = M_PI / (2 * n), larger = std::sqrt(angle / std::sin(angle));
    Lattice l;
    l.bricks = {n, n, layers};
    l.inside = [](const Place &x) { return x[1] <= x[0] + 1e-9; };
    l.map = [=](const Place &x) {
      const double theta = x[0] > 0 ? M_PI / 2 * x[1] / x[0] : 0, r = larger * x[0];
      return Place{x[1] == x[0] ? 0 : r * std::cos(theta), r * std::sin(theta), height * x[2]};
    };
    l.name = [](const Place &x) {
      if (x[2] < 1e-9) return "z0";
      if (x[2] > 1 - 1e-9) return "z1";
      if (x[1] < 1e-9) return "y0";
      return x[0] > 1 - 1e-9 ? "side" : "x0";
    };
    return l;
  }
  /// x, y, z >= 0 of a ball of unit radius: n cells along the radius and along each edge of its surface. Surfaces x0,
  /// y0, z0, side. The radius is larger so that the volume is that of the ball.
  static Lattice octant_of_ball(int n)
  {
    Lattice l;
    l.bricks = {n, n, n};
    l.inside = [](const Place &x) { return x[1] <= x[0] + 1e-9 && x[2] <= x[1] + 1e-9; };
    const auto at = [](const Place &x, double larger) {
      Place y{0, 0, 0};
      if (x[0] <= 0) return y;
      const double share[3] = {x[0] - x[1], x[1] - x[2], x[2]};
      double size = 0;
      for (int d = 0; d < 3; ++d) y[d] = std::sin(M_PI / 2 * share[d] / x[0]);
      for (double v : y) size += v * v;
      for (double &v : y) v *= larger * x[0] / std::sqrt(size);
      return y;
    };
    l.map = [at](const Place &x) { return at(x, 1); };
    const double larger = std::cbrt(M_PI / 6 / l.volume());
    l.map = [=](const Place &x) { return at(x, larger); };
    l.name = [](const Place &x) {
      if (x[0] > 1 - 1e-9) return "side";
      if (x[2] < 1e-9) return "z0";
      return x[1] - x[2] < 1e-9 ? "y0" : "x0";
    };
    return l;
  }

  /// Corners of the tetrahedra by number, right-handed; fills the places of the points.
  std::vector<std::array<int, 4>> cells(std::vector<Place> &places) const
  {
    std::map<std::array<int, 3>, int> number;
    std::vector<std::array<int, 4>> list;
    places.clear();
    const auto place = [this](const std::array<int, 3> &i) {
      return Place{double(i[0]) / bricks[0], double(i[1]) / bricks[1], double(i[2]) / bricks[2]};
    };
    for (int k = 0; k < bricks[2]; ++k)
      for (int j = 0; j < bricks[1]; ++j)
        for (int i = 0; i < bricks[0]; ++i) {
          std::array<int, 3> axes{0, 1, 2};
          do {
            std::array<std::array<int, 3>, 4> corner;
            corner.fill({i, j, k});
            for (int step = 0; step < 3; ++step)
              for (int c = step + 1; c < 4; ++c) ++corner[c][axes[step]];
            if (!std::all_of(corner.begin(), corner.end(), [&](const auto &c) { return inside(place(c)); })) continue;
            std::array<int, 4> cell;
            for (int c = 0; c < 4; ++c) {
              const auto [found, added] = number.insert({corner[c], static_cast<int>(places.size())});
              if (added) places.push_back(place(corner[c]));
              cell[c] = found->second;
            }
            list.push_back(cell);
          } while (std::next_permutation(axes.begin(), axes.end()));
        }
    for (auto &cell : list)
      if (volume_of(cell, places) < 0) std::swap(cell[0], cell[1]);
    return list;
  }

  double volume() const
  {
    std::vector<Place> places;
    double sum = 0;
    for (const auto &cell : cells(places)) sum += volume_of(cell, places);
    return sum;
  }

private:
  double volume_of(const std::array<int, 4> &cell, const std::vector<Place> &places) const
  {
    double e[3][3];
    const Place origin = map(places[cell[0]]);
    for (int c = 0; c < 3; ++c) {
      const Place x = map(places[cell[c + 1]]);
      for (int d = 0; d < 3; ++d) e[c][d] = x[d] - origin[d];
    }
    return (e[0][0] * (e[1][1] * e[2][2] - e[1][2] * e[2][1]) - e[0][1] * (e[1][0] * e[2][2] - e[1][2] * e[2][0]) +
            e[0][2] * (e[1][0] * e[2][1] - e[1][1] * e[2][0])) /
           6;
  }
};

/// The file of a lattice's mesh.
class LatticeFile {
public:
  explicit LatticeFile(const Lattice &lattice)
  {
    static int count = 0;
    path_ = std::filesystem::temp_directory_path() /
            ("pulmo_lattice_" + std::to_string(getpid()) + "_" + std::to_string(++count) + ".msh");
    std::vector<Lattice::Place> places;
    const auto cells = lattice.cells(places);
    std::map<std::array<int, 3>, int> seen; // triangle -> how many cells have it
    for (const auto &cell : cells)
      for (int apex = 0; apex < 4; ++apex) ++seen[triangle(cell, apex)];
    std::vector<std::pair<std::array<int, 3>, int>> boundary;
    std::map<std::string, int> tags;
    for (const auto &[corners, times] : seen) {
      if (times != 1) continue;
      Lattice::Place centre{0, 0, 0};
      for (int c : corners)
        for (int d = 0; d < 3; ++d) centre[d] += places[c][d] / 3;
      boundary.emplace_back(corners, tags.insert({lattice.name(centre), tags.size() + 1}).first->second);
    }
    std::map<std::string, int> parts;
    std::vector<int> part_of;
    for (const auto &cell : cells) {
      Lattice::Place centre{0, 0, 0};
      for (int c : cell)
        for (int d = 0; d < 3; ++d) centre[d] += places[c][d] / 4;
      part_of.push_back(parts.insert({lattice.part(centre), tags.size() + parts.size() + 1}).first->second);
    }
    std::ofstream out(path_);
    out.precision(17);
    out << "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n" << tags.size() + parts.size() << "\n";
    for (const auto &[name, tag] : tags) out << "2 " << tag << " \"" << name << "\"\n";
    for (const auto &[name, tag] : parts) out << "3 " << tag << " \"" << name << "\"\n";
    out << "$EndPhysicalNames\n$Nodes\n" << places.size() << "\n";
    for (std::size_t i = 0; i < places.size(); ++i) {
      const Lattice::Place x = lattice.map(places[i]);
      out << i + 1 << " " << x[0] << " " << x[1] << " " << x[2] << "\n";
    }
    out << "$EndNodes\n$Elements\n" << boundary.size() + cells.size() << "\n";
    std::size_t element = 0;
    for (const auto &[corners, tag] : boundary) {
      out << ++element << " 2 2 " << tag << " " << tag;
      for (int c : corners) out << " " << c + 1;
      out << "\n";
    }
    for (std::size_t i = 0; i < cells.size(); ++i) {
      out << ++element << " 4 2 " << part_of[i] << " " << part_of[i];
      for (int c : cells[i]) out << " " << c + 1;
      out << "\n";
    }
    out << "$EndElements\n";
  }
  ~LatticeFile()
  {
    std::error_code ignored;
    std::filesystem::remove(path_, ignored);
  }
  LatticeFile(const LatticeFile &) = delete;
  LatticeFile &operator=(const LatticeFile &) = delete;

  std::string path() const { return path_.string(); }

private:
  static std::array<int, 3> triangle(const std::array<int, 4> &cell, int apex)
  {
    std::array<int, 3> corners;
    for (int c = 0, i = 0; c < 4; ++c)
      if (c != apex) corners[i++] = cell[c];
    std::sort(corners.begin(), corners.end());
    return corners;
  }

  std::filesystem::path path_;
};

} // namespace pulmo::test
