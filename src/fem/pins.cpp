#include "pulmo/fem/pins.hpp"

#include "pulmo/base/units.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

using Place = std::array<PetscReal, 3>;

/// A component of a vertex that is to be pinned.
struct PinChoice {
  Place x;
  int component;
};

/// As many components of vertices as there are free motions, so that none of these is left when the components are
/// held: one after another the one that the motions which are left move most. What else holds the body does not move
/// along any of them and is not chosen.
PetscErrorCode choose_pins(const Mesh &mesh, const HeldBody &held, std::vector<PinChoice> &pins)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)mesh.dm());
  const std::size_t m = held.free.size();
  constexpr PetscReal tie = 1 - 1e-6; // rounding must not choose
  std::vector<PetscInt> vertices;
  std::vector<std::vector<PetscReal>> taken; // orthonormal, in the coordinates of the free motions
  PetscMPIInt size;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_size(comm, &size));
  PetscCall(mesh.vertices(held.body, vertices));
  std::vector<Place> places(vertices.size());
  std::vector<std::vector<PetscReal>> rows(3 * vertices.size(), std::vector<PetscReal>(m));
  for (std::size_t v = 0; v < vertices.size(); ++v) {
    PetscReal r[3];
    PetscCall(mesh.node_coordinates(vertices[v], places[v].data()));
    for (int d = 0; d < 3; ++d) r[d] = (places[v][d] - held.body.centroid[d]) / held.size;
    for (std::size_t j = 0; j < m; ++j) {
      const Place u = displacement_of(held.free[j], r);
      for (int d = 0; d < 3; ++d) rows[3 * v + d][j] = u[d];
    }
  }
  const auto norm = [](const std::vector<PetscReal> &row) {
    PetscReal sum = 0;
    for (const PetscReal x : row) sum += x * x;
    return std::sqrt(sum);
  };
  while (pins.size() < m) {
    using Candidate = std::array<double, 4>; // coordinates, component
    Candidate best{HUGE_VAL, 0, 0, 0};
    PetscReal largest = 0;
    for (const auto &row : rows) largest = std::max(largest, norm(row));
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &largest, 1, MPIU_REAL, MPI_MAX, comm));
    for (std::size_t i = 0; i < rows.size(); ++i)
      if (norm(rows[i]) >= tie * largest) {
        const Place &x = places[i / 3];
        best = std::min(best, Candidate{x[0], x[1], x[2], (double)(i % 3)});
      }
    std::vector<Candidate> all(size);
    PetscCallMPI(MPI_Allgather(best.data(), 4, MPI_DOUBLE, all.data(), 4, MPI_DOUBLE, comm));
    best = *std::min_element(all.begin(), all.end());
    pins.push_back({{best[0], best[1], best[2]}, static_cast<int>(best[3])});

    PetscReal r[3];
    std::vector<PetscReal> row(m);
    for (int d = 0; d < 3; ++d) r[d] = (best[d] - held.body.centroid[d]) / held.size;
    for (std::size_t j = 0; j < m; ++j) row[j] = displacement_of(held.free[j], r)[pins.back().component];
    const auto remove = [m](std::vector<PetscReal> &from, const std::vector<PetscReal> &direction) {
      PetscReal along = 0;
      for (std::size_t j = 0; j < m; ++j) along += from[j] * direction[j];
      for (std::size_t j = 0; j < m; ++j) from[j] -= along * direction[j];
    };
    for (const auto &direction : taken) remove(row, direction);
    const PetscReal length = norm(row);
    for (PetscReal &x : row) x /= length;
    taken.push_back(row);
    for (auto &other : rows) remove(other, row);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The vertex of a body at @p x on this rank, or none.
PetscErrorCode vertex_at(const Mesh &mesh, const Mesh::Body &body, const Place &x, std::vector<PetscInt> &found)
{
  std::vector<PetscInt> vertices;

  PetscFunctionBeginUser;
  found.clear();
  PetscCall(mesh.vertices(body, vertices));
  for (const PetscInt v : vertices) {
    Place at;
    PetscCall(mesh.node_coordinates(v, at.data()));
    if (at == x && found.empty()) found.push_back(v);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode pin_free_motions(Composition &composition)
{
  const Mesh &mesh = composition.mesh();
  const MPI_Comm comm = PetscObjectComm((PetscObject)mesh.dm());
  std::vector<HeldBody> held;
  std::vector<Mesh::Body> bodies;
  Mesh::Hinge hinge;

  PetscFunctionBeginUser;
  if (composition.pins_for().empty()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(find_held(composition, held));
  for (const HeldBody &one : held) bodies.push_back(one.body);
  PetscCall(mesh.hinge(bodies, hinge));
  for (const PetscInt body : hinge.body)
    PulmoUserCheck(
        body < 0 || held[body].free.empty(), comm,
        "-support_rigid: two bodies of mesh %s hang together at (%.6g, %.6g, %.6g) mm by a vertex or an edge "
        "alone, and pins of both would strain them there; join them by facets, or give each its own nodes",
        mesh.file().c_str(), (double)hinge.x[0], (double)hinge.x[1], (double)hinge.x[2]);
  composition.speaker(composition.pins_for());
  for (std::size_t b = 0; b < held.size(); ++b) {
    std::vector<Mesh::Pin> pins;
    if (held[b].free.size() == std::tuple_size<RigidMotion>::value) {
      PetscCall(mesh.rigid_pins(held[b].body, pins));
    } else if (!held[b].free.empty()) {
      std::vector<PinChoice> choices;
      PetscCall(choose_pins(mesh, held[b], choices));
      for (const PinChoice &choice : choices) {
        Mesh::Pin pin;
        std::vector<PetscInt> vertex;
        std::copy(choice.x.begin(), choice.x.end(), pin.x);
        pin.component[choice.component] = true;
        PetscCall(vertex_at(mesh, held[b].body, choice.x, vertex));
        if (!vertex.empty()) pin.vertex = vertex[0];
        pins.push_back(pin);
      }
    }
    for (const Mesh::Pin &pin : pins) {
      Constraint hold;
      hold.name = "pin";
      hold.pinned_body = static_cast<PetscInt>(b);
      for (int d = 0; d < 3; ++d) hold.component[d] = pin.component[d];
      if (pin.vertex >= 0) hold.vertices.push_back(pin.vertex);
      hold.value = [](PetscReal, const PetscReal[3], PetscScalar u[3]) { u[0] = u[1] = u[2] = 0; };
      composition.constrain(hold);
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode PinForces::follow(const Model &model, const std::vector<std::array<PetscReal, 3>> &forces, Vec local,
                                 PetscReal t, PetscReal gas_pressure)
{
  const auto &constraints = model.composition().constraints();
  const Mesh &mesh = model.composition().mesh();
  const MPI_Comm comm = PetscObjectComm((PetscObject)mesh.dm());
  PetscSection section;
  PetscInt begin, end, strongest = -1;
  PetscReal farthest = 0, force = 0;

  PetscFunctionBeginUser;
  for (std::size_t k = 0; k < constraints.size(); ++k) {
    const PetscReal size = std::hypot(forces[k][0], forces[k][1], forces[k][2]);
    if (constraints[k].pinned_body < 0 || size <= force) continue;
    force = size;
    strongest = constraints[k].pinned_body;
  }
  if (strongest < 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(DMGetLocalSection(model.dm(), &section));
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  {
    const ReadArray x(local);
    for (PetscInt p = begin; p < end; ++p) {
      PetscInt dof, offset;
      PetscCall(PetscSectionGetFieldDof(section, p, displacement, &dof));
      PetscCall(PetscSectionGetFieldOffset(section, p, displacement, &offset));
      for (PetscInt d = 0; d < dof; ++d) farthest = std::max(farthest, std::abs(x[offset + d]));
    }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &farthest, 1, MPIU_REAL, MPI_MAX, comm));
  // the stress that the gas and the strain make, over a section of the lung
  const PetscReal length = std::cbrt(mesh.volume());
  loads_ = std::max(loads_, length * length * (std::abs(gas_pressure) + model.modulus() * farthest / length));
  if (force > largest_) {
    largest_ = force;
    time_ = t;
    body_ = strongest;
    sum_ = {};
    for (std::size_t k = 0; k < constraints.size(); ++k)
      if (constraints[k].pinned_body == body_)
        for (int d = 0; d < 3; ++d) sum_[d] += forces[k][d];
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode PinForces::persist(Archive &archive)
{
  PetscFunctionBeginUser;
  PetscCall(archive.value("pin_force_kPa_mm2", largest_));
  PetscCall(archive.value("pin_loads_kPa_mm2", loads_));
  PetscCall(archive.value("pin_force_time_s", time_));
  PetscCall(archive.value("pin_force_body", body_));
  for (int d = 0; d < 3; ++d) PetscCall(archive.value("pin_force_sum_" + std::string(1, "xyz"[d]), sum_[d]));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode PinForces::warn(const Model &model) const
{
  const Mesh &mesh = model.composition().mesh();
  constexpr PetscReal newton = units::newton_per_kPa_mm2;
  std::vector<Mesh::Body> bodies;

  PetscFunctionBeginUser;
  if (!loaded()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(mesh.bodies(bodies));
  PetscReal load[3]; // on the pins, N
  for (int d = 0; d < 3; ++d) load[d] = std::abs(sum_[d]) > faint * largest_ ? -sum_[d] * newton : 0;
  PetscCall(
      PetscPrintf(PetscObjectComm((PetscObject)mesh.dm()),
                  "pulmo: warning: a load goes along a rigid motion that only the pins of -support_rigid stop: at "
                  "t = %.6g s those of %s bear (%.4g, %.4g, %.4g) N in all, and %.4g N the most loaded one. A "
                  "force at a vertex dents the tissue there; hold the lung where its load is borne "
                  "(-chest_wall, -support_surfaces)\n",
                  (double)time_, mesh.body_text(bodies[body_]).c_str(), (double)load[0], (double)load[1],
                  (double)load[2], (double)(largest_ * newton)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
