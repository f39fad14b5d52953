#include "pulmo/fem/held.hpp"

#include "pulmo/mesh/shared_points.hpp"
#include "pulmo/physics/parameter_fields.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace pulmo {

namespace {

constexpr std::size_t n_motions = 6;
/// A motion is free if what holds it does so by less than this share of the strongest, squared: a lever of 1e-5 of the
/// body's size is rounding of the coordinates.
constexpr PetscReal nothing = 1e-10;
/// Springs that hold a motion by less than this share of what they hold best do so by the facets of the mesh, or
/// barely: normal springs on a body of revolution (0.021 on meshes/hollow_sphere.msh, 0.03 and more on lungs).
constexpr PetscReal barely = 0.025;
/// Springs that hold a motion by less than this share of the tissue's stiffness leave a matrix that is almost singular.
constexpr PetscReal hardly_regular = 1e-8;

using Gram = std::array<PetscReal, n_motions * n_motions>;
using Place = std::array<PetscReal, 3>;

PetscReal dot(const PetscReal a[3], const PetscReal b[3])
{
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/// Eigenvalues in ascending order, and eigenvectors as the rows of @p A, of a symmetric n x n matrix (Jacobi's method).
std::vector<PetscReal> eigen(std::size_t n, std::vector<PetscReal> &A)
{
  std::vector<PetscReal> V(n * n, 0), values(n);
  std::vector<std::size_t> order(n);
  PetscReal size = 0;

  for (std::size_t i = 0; i < n; ++i) V[(n + 1) * i] = 1;
  for (const PetscReal a : A) size = std::max(size, std::abs(a));
  bool rotated = true;
  for (int sweep = 0; rotated && sweep < 100; ++sweep) { // a handful are enough
    rotated = false;
    for (std::size_t p = 0; p < n; ++p)
      for (std::size_t q = p + 1; q < n; ++q) {
        const PetscReal off = A[n * p + q];
        if (std::abs(off) <= PETSC_MACHINE_EPSILON * size * 1e-2) continue;
        rotated = true;
        const PetscReal theta = (A[(n + 1) * q] - A[(n + 1) * p]) / (2 * off);
        const PetscReal t = (theta < 0 ? -1 : 1) / (std::abs(theta) + std::hypot(theta, 1)); // the smaller angle
        const PetscReal c = 1 / std::hypot(t, 1), s = t * c;
        const auto turn = [c, s](PetscReal &x, PetscReal &y) {
          const PetscReal old = x;
          x = c * old - s * y;
          y = s * old + c * y;
        };
        for (std::size_t k = 0; k < n; ++k) turn(A[n * k + p], A[n * k + q]);
        for (std::size_t k = 0; k < n; ++k) turn(A[n * p + k], A[n * q + k]);
        for (std::size_t k = 0; k < n; ++k) turn(V[n * p + k], V[n * q + k]);
        A[n * p + q] = A[n * q + p] = 0;
      }
  }
  std::iota(order.begin(), order.end(), 0);
  std::sort(order.begin(), order.end(), [&](std::size_t i, std::size_t j) { return A[(n + 1) * i] < A[(n + 1) * j]; });
  for (std::size_t k = 0; k < n; ++k) values[k] = A[(n + 1) * order[k]];
  for (std::size_t k = 0; k < n; ++k) std::copy_n(&V[n * order[k]], n, &A[n * k]);
  return values;
}

/// The six rigid motions at (x - c) / R = @p r.
std::array<Place, n_motions> unit_motions(const PetscReal r[3])
{
  std::array<Place, n_motions> u{};
  for (std::size_t a = 0; a < n_motions; ++a) {
    RigidMotion motion{};
    motion[a] = 1;
    u[a] = displacement_of(motion, r);
  }
  return u;
}

/// Something that holds: a constraint, or a term that resists displacement.
struct Hold {
  const Constraint *constraint = nullptr;
  const Term *term = nullptr;

  const std::string &surface() const { return constraint ? constraint->surface : term->surface; }
};

std::vector<Hold> holds_of(const Composition &composition)
{
  std::vector<Hold> list;
  for (const Constraint &c : composition.constraints())
    if (c.field == displacement) list.push_back({&c, nullptr});
  for (const Term &t : composition.terms())
    if (t.test == displacement && t.trial == displacement && (t.g0 || t.bd_g0)) list.push_back({nullptr, &t});
  return list;
}

/// The force per displacement that a term answers with at rest, K[3 i + j].
class Resistance {
public:
  explicit Resistance(const Composition &composition)
      : varying_(composition.varying()), constants_(composition.constants(Step()))
  {
    PetscInt components = 0;
    for (const FieldSpec &field : composition.fields()) {
      offset_.push_back(components);
      gradient_offset_.push_back(3 * components);
      components += field.components;
    }
    zero_.assign(static_cast<std::size_t>(3 * components), 0);
  }

  /// @p normal: null in the volume. @p cell: of this rank, counted from 0; behind the facet.
  void at(const Term &term, PetscInt cell, const PetscReal x[3], const PetscReal *normal, PetscScalar K[9])
  {
    if (varying_) varying_->patch(cell, term.surface, constants_);
    const auto fields = static_cast<PetscInt>(offset_.size());
    const auto n = static_cast<PetscInt>(constants_.size());
    std::fill(K, K + 9, 0);
    if (normal)
      term.bd_g0(3, fields, 0, offset_.data(), gradient_offset_.data(), zero_.data(), nullptr, zero_.data(), nullptr,
                 nullptr, nullptr, nullptr, nullptr, 0, 0, x, normal, n, constants_.data(), K);
    else
      term.g0(3, fields, 0, offset_.data(), gradient_offset_.data(), zero_.data(), nullptr, zero_.data(), nullptr,
              nullptr, nullptr, nullptr, nullptr, 0, 0, x, n, constants_.data(), K);
  }

private:
  const ParameterFields *varying_;
  std::vector<PetscScalar> constants_, zero_;
  std::vector<PetscInt> offset_, gradient_offset_;
};

/// Sums up the Gram matrices of each hold on each body.
class GramSums {
public:
  GramSums(const Composition &composition, const std::vector<HeldBody> &bodies, std::vector<Hold> holds)
      : mesh_(composition.mesh()), bodies_(bodies), holds_(std::move(holds)), resistance_(composition),
        sums_(bodies.size() * holds_.size())
  {}

  PetscErrorCode make()
  {
    std::vector<Mesh::Body> list;
    PetscInt cell_end;

    PetscFunctionBeginUser;
    for (const HeldBody &b : bodies_) list.push_back(b.body);
    PetscCall(mesh_.body_of_cells(list, body_of_));
    PetscCall(DMPlexGetHeightStratum(mesh_.dm(), 0, &cell_begin_, &cell_end));
    for (std::size_t h = 0; h < holds_.size(); ++h) {
      const Hold &hold = holds_[h];
      if (!hold.surface().empty())
        PetscCall(add_surface(h));
      else if (hold.constraint)
        PetscCall(add_vertices(h));
      else
        for (PetscInt c = cell_begin_; c < cell_end; ++c) PetscCall(add_cell(h, c));
    }
    static_assert(sizeof(Sum) == (n_motions * n_motions + 1) * sizeof(PetscReal));
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums_.data(),
                               static_cast<PetscMPIInt>(sums_.size() * sizeof(Sum) / sizeof(PetscReal)), MPIU_REAL,
                               MPI_SUM, PetscObjectComm((PetscObject)mesh_.dm())));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// What supports hold of a body, each hold's largest about 1.
  Gram supports(std::size_t body) const { return sum(body, true, true); }
  /// What springs hold of it: the same, or in kPa mm.
  Gram springs(std::size_t body, bool relative) const { return sum(body, false, relative); }

private:
  struct Sum {
    Gram gram{};
    PetscReal measure = 0;
  };

  Gram sum(std::size_t body, bool supports, bool relative) const
  {
    Gram total{};
    for (std::size_t h = 0; h < holds_.size(); ++h) {
      const Sum &one = sums_[body * holds_.size() + h];
      if ((holds_[h].constraint != nullptr) != supports || one.measure == 0) continue;
      PetscReal scale = 1;
      if (relative) { // strong and weak holds count alike: what holds at all is asked
        PetscReal trace = 0;
        for (std::size_t a = 0; a < n_motions; ++a) trace += one.gram[(n_motions + 1) * a];
        scale = trace > 0 ? 1 / trace : 0;
      }
      for (std::size_t i = 0; i < total.size(); ++i) total[i] += scale * one.gram[i];
    }
    return total;
  }

  /// Adds what holds a point of a body with K, or in the components of a constraint.
  void add_point(std::size_t hold, PetscInt body, PetscInt cell, const PetscReal x[3], PetscReal weight,
                 const PetscReal *normal)
  {
    const HeldBody &b = bodies_[static_cast<std::size_t>(body)];
    Sum &sum = sums_[static_cast<std::size_t>(body) * holds_.size() + hold];
    PetscReal r[3];
    PetscScalar K[9] = {0};
    for (int d = 0; d < 3; ++d) r[d] = (x[d] - b.body.centroid[d]) / b.size;
    if (const Constraint *constraint = holds_[hold].constraint)
      for (int d = 0; d < 3; ++d) K[4 * d] = constraint->component[d];
    else
      resistance_.at(*holds_[hold].term, cell, x, normal, K);
    const auto u = unit_motions(r);
    for (std::size_t a = 0; a < n_motions; ++a)
      for (std::size_t c = 0; c < n_motions; ++c)
        for (int i = 0; i < 3; ++i) sum.gram[n_motions * a + c] += weight * u[a][i] * dot(K + 3 * i, u[c].data());
    sum.measure += weight;
  }

  /// Exact: motions are linear, and so their products quadratic.
  PetscErrorCode add_surface(std::size_t hold)
  {
    const DM dm = mesh_.dm();
    std::vector<PetscInt> facets;

    PetscFunctionBeginUser;
    PetscCall(mesh_.facets(holds_[hold].surface(), facets));
    for (const PetscInt facet : facets) {
      const PetscInt *cell, *edges;
      PetscReal area, volume, centre[3], inside[3], normal[3];
      PetscCall(DMPlexGetSupport(dm, facet, &cell));
      PetscCall(DMPlexComputeCellGeometryFVM(dm, facet, &area, centre, normal));
      PetscCall(DMPlexComputeCellGeometryFVM(dm, cell[0], &volume, inside, nullptr));
      for (int d = 0; d < 3; ++d) inside[d] -= centre[d];
      if (dot(inside, normal) > 0)
        for (PetscReal &component : normal) component = -component;
      PetscCall(DMPlexGetCone(dm, facet, &edges));
      for (int e = 0; e < 3; ++e) {
        PetscReal x[3];
        PetscCall(mesh_.node_coordinates(edges[e], x));
        add_point(hold, body_of_[cell[0] - cell_begin_], cell[0] - cell_begin_, x, area / 3, normal);
      }
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// Shared vertices count on every rank that has them; nothing but their weight depends on it.
  PetscErrorCode add_vertices(std::size_t hold)
  {
    PetscFunctionBeginUser;
    for (const PetscInt vertex : holds_[hold].constraint->vertices) {
      PetscInt *star = nullptr, n;
      PetscReal x[3];
      std::vector<PetscInt> bodies;
      PetscCall(mesh_.node_coordinates(vertex, x));
      PetscCall(DMPlexGetTransitiveClosure(mesh_.dm(), vertex, PETSC_FALSE, &n, &star));
      for (PetscInt i = 0; i < n; ++i) {
        const PetscInt c = star[2 * i] - cell_begin_;
        if (c >= 0 && c < static_cast<PetscInt>(body_of_.size())) bodies.push_back(body_of_[c]);
      }
      PetscCall(DMPlexRestoreTransitiveClosure(mesh_.dm(), vertex, PETSC_FALSE, &n, &star));
      std::sort(bodies.begin(), bodies.end());
      bodies.erase(std::unique(bodies.begin(), bodies.end()), bodies.end());
      for (const PetscInt body : bodies) add_point(hold, body, -1, x, 1, nullptr);
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode add_cell(std::size_t hold, PetscInt cell)
  {
    constexpr PetscReal near = 0.5854101966249685, far = (1 - near) / 3; // exact for quadratics
    PetscInt *closure = nullptr, n;
    PetscReal volume, corner[4][3];

    PetscFunctionBeginUser;
    PetscCall(DMPlexComputeCellGeometryFVM(mesh_.dm(), cell, &volume, nullptr, nullptr));
    PetscCall(DMPlexGetTransitiveClosure(mesh_.dm(), cell, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 0; i < 4; ++i) PetscCall(mesh_.node_coordinates(closure[2 * (n - 4 + i)], corner[i]));
    PetscCall(DMPlexRestoreTransitiveClosure(mesh_.dm(), cell, PETSC_TRUE, &n, &closure));
    for (int q = 0; q < 4; ++q) {
      PetscReal x[3] = {0, 0, 0};
      for (int i = 0; i < 4; ++i)
        for (int d = 0; d < 3; ++d) x[d] += (i == q ? near : far) * corner[i][d];
      add_point(hold, body_of_[cell - cell_begin_], cell - cell_begin_, x, volume / 4, nullptr);
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  const Mesh &mesh_;
  const std::vector<HeldBody> &bodies_;
  const std::vector<Hold> holds_;
  Resistance resistance_;
  PetscInt cell_begin_ = 0;
  std::vector<PetscInt> body_of_;
  std::vector<Sum> sums_; // [body][hold]
};

PetscErrorCode find_sizes(const Mesh &mesh, std::vector<HeldBody> &held)
{
  std::vector<PetscReal> sizes(held.size(), 0);

  PetscFunctionBeginUser;
  for (std::size_t b = 0; b < held.size(); ++b) {
    std::vector<PetscInt> vertices;
    PetscCall(mesh.vertices(held[b].body, vertices));
    for (const PetscInt v : vertices) {
      PetscReal x[3];
      PetscCall(mesh.node_coordinates(v, x));
      for (int d = 0; d < 3; ++d) x[d] -= held[b].body.centroid[d];
      sizes[b] = std::max(sizes[b], std::sqrt(dot(x, x)));
    }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sizes.data(), static_cast<PetscMPIInt>(sizes.size()), MPIU_REAL, MPI_MAX,
                             PetscObjectComm((PetscObject)mesh.dm())));
  for (std::size_t b = 0; b < held.size(); ++b) held[b].size = sizes[b];
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Orthonormal motions for which @p gram is nothing beside its largest eigenvalue (all six if it is zero).
std::vector<RigidMotion> null_space(const Gram &gram)
{
  std::vector<PetscReal> vectors(gram.begin(), gram.end());
  const std::vector<PetscReal> values = eigen(n_motions, vectors);
  std::vector<RigidMotion> motions;

  for (std::size_t k = 0; k < n_motions && values[k] <= nothing * values.back(); ++k) {
    motions.emplace_back();
    std::copy_n(&vectors[n_motions * k], n_motions, motions.back().begin());
  }
  return motions;
}

/// The weakest motion that springs alone hold.
void find_weakest(const std::vector<RigidMotion> &unsupported, const Gram &springs, HeldBody &held)
{
  std::vector<PetscReal> all(springs.begin(), springs.end());
  const std::size_t n = unsupported.size(), k = held.free.size(); // the free ones come first
  std::vector<PetscReal> projected(n * n, 0);

  if (k >= n) return;
  held.largest_stiffness = eigen(n_motions, all).back();
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = 0; j < n; ++j)
      for (std::size_t a = 0; a < n_motions; ++a)
        for (std::size_t b = 0; b < n_motions; ++b)
          projected[n * i + j] += unsupported[i][a] * springs[n_motions * a + b] * unsupported[j][b];
  held.weakest_stiffness = eigen(n, projected)[k];
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t a = 0; a < n_motions; ++a) held.weakest[a] += projected[n * k + i] * unsupported[i][a];
}

/// An orthonormal basis of what a projector keeps, with the axes that lie in it first.
std::vector<Place> axes_first(std::array<PetscReal, 9> projector)
{
  constexpr PetscReal rounding = 1e-6;
  std::vector<Place> basis;

  for (int axis = 0; axis < 3; ++axis)
    if (projector[4 * axis] > 1 - rounding) {
      basis.emplace_back();
      basis.back()[axis] = 1;
      for (int i = 0; i < 3; ++i) projector[3 * axis + i] = projector[3 * i + axis] = 0;
    }
  std::vector<PetscReal> vectors(projector.begin(), projector.end());
  const std::vector<PetscReal> values = eigen(3, vectors);
  for (int k = 0; k < 3; ++k)
    if (values[k] > 0.5) {
      Place e{vectors[3 * k], vectors[3 * k + 1], vectors[3 * k + 2]};
      const auto largest = std::max_element(
          e.begin(), e.end(), [](PetscReal a, PetscReal b) { return std::abs(a) < std::abs(b) - rounding; });
      if (*largest < 0)
        for (PetscReal &component : e) component = -component;
      basis.push_back(e);
    }
  return basis;
}

std::string direction_text(const Place &e)
{
  for (int axis = 0; axis < 3; ++axis)
    if (e[axis] > 1 - 1e-9) return std::string(1, "xyz"[axis]);
  char text[80];
  std::snprintf(text, sizeof(text), "(%.3f, %.3f, %.3f)", (double)e[0] + 0., (double)e[1] + 0., (double)e[2] + 0.);
  return text;
}

/// The translations among the span of @p motions, and the axes about which some motion of it turns, each with the
/// displacement of the centroid that goes with it (least, and without what the translations give).
struct Parts {
  std::vector<Place> translations;
  std::vector<std::pair<Place, Place>> turns; ///< axis, displacement of the centroid
};

Parts take_apart(const std::vector<RigidMotion> &motions)
{
  const std::size_t m = motions.size();
  std::vector<PetscReal> mixing(m * m, 0);
  std::array<PetscReal, 9> shifts{}, axes{}; // projectors
  std::vector<RigidMotion> turning;          // of unit turn, these at right angles to one another
  Parts parts;

  for (std::size_t i = 0; i < m; ++i)
    for (std::size_t j = 0; j < m; ++j) mixing[m * i + j] = dot(&motions[i][3], &motions[j][3]);
  const std::vector<PetscReal> values = eigen(m, mixing);
  for (std::size_t k = 0; k < m; ++k) {
    RigidMotion motion{};
    for (std::size_t i = 0; i < m; ++i)
      for (std::size_t a = 0; a < n_motions; ++a) motion[a] += mixing[m * k + i] * motions[i][a];
    const bool turns = values[k] > 1e-8;
    if (turns) {
      for (PetscReal &component : motion) component /= std::sqrt(values[k]);
      turning.push_back(motion);
    }
    const PetscReal *direction = turns ? &motion[3] : &motion[0];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) (turns ? axes : shifts)[3 * i + j] += direction[i] * direction[j];
  }
  parts.translations = axes_first(shifts);
  for (const Place &w : axes_first(axes)) {
    Place s{};
    for (const RigidMotion &motion : turning)
      for (int d = 0; d < 3; ++d) s[d] += dot(&motion[3], w.data()) * motion[d];
    for (const Place &t : parts.translations) {
      const PetscReal along = dot(s.data(), t.data());
      for (int d = 0; d < 3; ++d) s[d] -= along * t[d];
    }
    parts.turns.emplace_back(w, s);
  }
  return parts;
}

} // namespace

std::array<PetscReal, 3> displacement_of(const RigidMotion &m, const PetscReal r[3])
{
  return {m[0] + m[4] * r[2] - m[5] * r[1], m[1] + m[5] * r[0] - m[3] * r[2], m[2] + m[3] * r[1] - m[4] * r[0]};
}

PetscErrorCode find_held(const Composition &composition, std::vector<HeldBody> &held)
{
  const Mesh &mesh = composition.mesh();
  std::vector<Mesh::Body> bodies;

  PetscFunctionBeginUser;
  PetscCall(mesh.bodies(bodies));
  held.assign(bodies.size(), HeldBody());
  for (std::size_t b = 0; b < bodies.size(); ++b) held[b].body = std::move(bodies[b]);
  PetscCall(find_sizes(mesh, held));
  GramSums sums(composition, held, holds_of(composition));
  PetscCall(sums.make());
  for (std::size_t b = 0; b < held.size(); ++b) {
    Gram all = sums.supports(b);
    const std::vector<RigidMotion> unsupported = null_space(all);
    const Gram springs = sums.springs(b, true);
    for (std::size_t i = 0; i < all.size(); ++i) all[i] += springs[i];
    held[b].free = null_space(all);
    find_weakest(unsupported, sums.springs(b, false), held[b]);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string describe(const HeldBody &held, const std::vector<RigidMotion> &motions)
{
  std::string text;

  if (motions.size() == n_motions) return "every rigid motion";
  const Parts parts = take_apart(motions);
  const auto add = [&text](const std::string &more) { text += (text.empty() ? "" : ", ") + more; };
  for (const Place &t : parts.translations) add("translation along " + direction_text(t));
  for (const auto &[w, s] : parts.turns) {
    const Place lever{w[1] * s[2] - w[2] * s[1], w[2] * s[0] - w[0] * s[2], w[0] * s[1] - w[1] * s[0]};
    char where[100];
    PetscReal x[3];
    for (int d = 0; d < 3; ++d) {
      x[d] = held.body.centroid[d] + held.size * lever[d];
      if (std::abs(x[d]) < 1e-6 * held.size) x[d] = 0;
    }
    std::snprintf(where, sizeof(where), " through (%.4g, %.4g, %.4g) mm", (double)x[0], (double)x[1], (double)x[2]);
    const bool screw = std::abs(dot(w.data(), s.data())) > 1e-4;
    add((screw ? "a screw motion about the axis along " : "rotation about the axis along ") + direction_text(w) +
        where);
  }
  return text;
}

PetscErrorCode check_held(MPI_Comm comm, const Composition &composition, PetscReal modulus)
{
  const Mesh &mesh = composition.mesh();
  std::vector<HeldBody> held;
  std::vector<Mesh::Body> bodies;
  Mesh::Hinge hinge;

  PetscFunctionBeginUser;
  PulmoUserCheck(
      !holds_of(composition).empty(), comm,
      "nothing holds the lung in place: give -chest_wall (springs), or -support -support_rigid to let it move "
      "freely but for the six rigid-body motions");
  PetscCall(find_held(composition, held));
  const char *wall = composition.surfaces_of("cavity").empty() ? "" : " (a wall holds nothing that it does not touch)";
  for (const HeldBody &one : held) {
    PulmoUserCheck(one.free.size() < n_motions, comm,
                   "%s is held in place by nothing%s: name a surface of it with -chest_wall_surfaces or "
                   "-support_surfaces, or join the bodies in gmsh",
                   mesh.body_text(one.body).c_str(), wall);
    PulmoUserCheck(one.free.empty(), comm,
                   "%s is still free to move%s: %s; hold it with more surfaces or components (-support_surfaces, "
                   "-chest_wall_surfaces), or give -support -support_rigid to pin just that",
                   mesh.body_text(one.body).c_str(), wall, describe(one, one.free).c_str());
    bodies.push_back(one.body);
  }
  for (const HeldBody &one : held) {
    if (one.largest_stiffness == 0 || one.weakest_stiffness == 0) continue;
    const PetscReal share = one.weakest_stiffness / one.largest_stiffness;
    const PetscReal against_tissue = one.weakest_stiffness / (modulus * one.size);
    if (share < barely)
      PetscCall(
          PetscPrintf(comm,
                      "pulmo: warning: springs hold %s barely against %s: by %.2g of what they hold best (smallest "
                      "eigenvalue %.3g kPa mm); if that is a surface of revolution, only the facets of its mesh "
                      "do: a load that way moves it far; hold it with -support, or with springs in full "
                      "(-chest_wall_direction full)\n",
                      mesh.body_text(one.body).c_str(), describe(one, {one.weakest}).c_str(), (double)share,
                      (double)one.weakest_stiffness));
    else if (against_tissue < hardly_regular)
      PetscCall(PetscPrintf(comm,
                            "pulmo: warning: springs hold %s %.2g times as stiffly as its tissue does: the equations "
                            "are almost singular; give a larger -chest_wall_stiffness, or -support -support_rigid "
                            "instead of the springs\n",
                            mesh.body_text(one.body).c_str(), (double)against_tissue));
  }
  PetscCall(mesh.hinge(bodies, hinge));
  if (hinge.body[0] >= 0)
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: two bodies of mesh %s hang together at (%.6g, %.6g, %.6g) mm by a vertex or "
                          "an edge alone: such a joint says nothing that finer meshes confirm; join them by facets, or "
                          "give each its own nodes\n",
                          mesh.file().c_str(), (double)hinge.x[0], (double)hinge.x[1], (double)hinge.x[2]));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode check_prescribed_once(const Composition &composition)
{
  const Mesh &mesh = composition.mesh();
  const DM dm = mesh.dm();
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  const auto &constraints = composition.constraints();
  constexpr PetscReal times[] = {0, 0.3, 1}; // s: constant values differ at once, others somewhere
  constexpr PetscReal rounding = 1e-12;
  PetscInt point_end, n_held = 0;

  PetscFunctionBeginUser;
  for (const Constraint &c : constraints) n_held += c.field == displacement && c.pinned_body < 0;
  if (n_held < 2) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(DMPlexGetChart(dm, nullptr, &point_end));
  // each point's first holder of a component, by the surfaces in turn, against the next
  std::vector<PetscInt> first(static_cast<std::size_t>(3 * point_end), -1);
  for (std::size_t k = 0; k < constraints.size(); ++k) {
    const Constraint &constraint = constraints[k];
    if (constraint.field != displacement || constraint.pinned_body >= 0) continue;
    std::vector<PetscInt> held(static_cast<std::size_t>(point_end), 0), facets;
    for (const PetscInt vertex : constraint.vertices) held[vertex] = 1;
    if (!constraint.surface.empty()) PetscCall(mesh.facets(constraint.surface, facets));
    for (const PetscInt facet : facets) {
      PetscInt *closure = nullptr, n;
      PetscCall(DMPlexGetTransitiveClosure(dm, facet, PETSC_TRUE, &n, &closure));
      for (PetscInt i = 0; i < n; ++i) held[closure[2 * i]] = 1;
      PetscCall(DMPlexRestoreTransitiveClosure(dm, facet, PETSC_TRUE, &n, &closure));
    }
    // an edge or vertex of a surface may be on a rank that has none of the surface's facets
    PetscCall(combine_shared(dm, MPI_MAX, held));
    struct {
      double difference;
      int rank;
    } worst{0, 0}, global;
    PetscMPIInt rank;
    PetscReal place[6] = {0, 0, 0, 0, 0, 0}; // then the two values
    PetscInt which[2] = {-1, -1};            // component, other constraint
    PetscCallMPI(MPI_Comm_rank(comm, &rank));
    worst.rank = rank;
    for (PetscInt p = 0; p < point_end; ++p) {
      PetscReal x[3];
      if (!held[p]) continue;
      PetscCall(mesh.node_coordinates(p, x));
      for (int c = 0; c < 3; ++c) {
        PetscInt &other = first[3 * p + c];
        if (!constraint.component[c]) continue;
        for (const PetscReal t : times) {
          PetscScalar mine[3] = {0, 0, 0}, theirs[3] = {0, 0, 0};
          if (other < 0) break;
          constraint.value(t, x, mine);
          constraints[other].value(t, x, theirs);
          const double difference = std::abs(mine[c] - theirs[c]);
          if (!(difference > rounding * std::max(std::abs(mine[c]), std::abs(theirs[c]))) || // or not a number
              difference <= worst.difference)
            continue;
          worst.difference = difference;
          std::copy_n(x, 3, place);
          place[3] = theirs[c];
          place[4] = mine[c];
          which[0] = c;
          which[1] = other;
        }
        if (other < 0) other = static_cast<PetscInt>(k);
      }
    }
    PetscCallMPI(MPI_Allreduce(&worst, &global, 1, MPI_DOUBLE_INT, MPI_MAXLOC, comm));
    PetscCallMPI(MPI_Bcast(place, 6, MPIU_REAL, global.rank, comm));
    PetscCallMPI(MPI_Bcast(which, 2, MPIU_INT, global.rank, comm));
    PulmoUserCheck(
        global.difference == 0, comm,
        "where surfaces '%s' and '%s' meet, at (%.6g, %.6g, %.6g) mm, the displacement along %c is prescribed "
        "twice: %.10g and %.10g mm; give both the same (-support_displacement_%s, -support_displacement_%s), "
        "or leave the component out of one (-support_components_%s)",
        constraints[which[1]].surface.c_str(), constraint.surface.c_str(), (double)place[0], (double)place[1],
        (double)place[2], "xyz"[which[0]], (double)place[3], (double)place[4], constraints[which[1]].surface.c_str(),
        constraint.surface.c_str(), constraint.surface.c_str());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
