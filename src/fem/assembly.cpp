#include "pulmo/fem/assembly.hpp"

#include "pulmo/base/simd.hpp"
#include "pulmo/fem/point_memory.hpp"
#include "pulmo/physics/parameter_fields.hpp"

#include <algorithm>
#include <cmath>
#include <memory>
#include <numeric>

namespace pulmo {

/// The facets of one boundary of the PetscDS.
struct Assembly::Facets {
  PetscWeakForm wf = nullptr;
  PetscFormKey key{};
  std::string surface;
  std::vector<PetscInt> points;     ///< the mesh points
  std::vector<PetscInt> cells;      ///< the cell behind each facet
  std::vector<PetscReal> constants; ///< [facet][those that differ from place to place]
  PetscFEGeom *geom = nullptr;

  ~Facets() { (void)PetscFEGeomDestroy(&geom); }
};

Assembly::~Assembly()
{
  for (Facets *f : facets_) delete f;
}

PetscErrorCode Assembly::setup(DM dm, PetscDS rate_ds, const ParameterFields *varying)
{
  PetscFunctionBeginUser;
  dm_ = dm;
  rate_ds_ = rate_ds;
  PetscCall(DMGetDS(dm, &ds_));
  PetscCall(PetscDSGetNumFields(ds_, &n_fields_));
  PetscCall(IntegrationLog::attach(ds_, &log_));
  PetscCall(setup_cells());
  PetscCall(setup_facets());
  if (varying) PetscCall(setup_varying(*varying));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::remember(const PointMemory &memory)
{
  PetscInt n;
  const PetscScalar *constants;

  PetscFunctionBeginUser;
  memory_ = &memory;
  PetscCall(PetscDSGetConstants(ds_, &n, &constants));
  place_memory_constant_ = constants::offset_of(constants::tag(PlaceMemory::owner), constants);
  PetscCall(PlaceData::attach(ds_, &places_));
  for (const Facets *facets : facets_) {
    const PointMemory::Room *room = memory.room(facets->surface);
    PetscCheck(!room || room->facets() == facets->points, PETSC_COMM_SELF, PETSC_ERR_PLIB,
               "memory and terms of surface %s differ in their facets", facets->surface.c_str());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::setup_varying(const ParameterFields &fields)
{
  PetscFunctionBeginUser;
  places_.offsets = fields.offsets();
  for (PetscInt c = 0; c < layout_.cells; ++c) fields.append(c, "", cell_constants_);
  for (Facets *facets : facets_) {
    for (const PetscInt cell : facets->cells) fields.append(cell, facets->surface, facets->constants);
  }
  PetscCall(PlaceData::attach(ds_, &places_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::setup_cells()
{
  PetscSection section;
  PetscInt last;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm_, &section));
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &first_cell_, &last));
  layout_.cells = last - first_cell_;
  PetscCall(PetscDSGetTotalDimension(ds_, &layout_.size));
  layout_.dofs.resize(static_cast<std::size_t>(layout_.cells * layout_.size));
  v0_.resize(3 * layout_.cells);
  J_.resize(9 * layout_.cells);
  invJ_.resize(9 * layout_.cells);
  detJ_.resize(layout_.cells);
  for (PetscInt c = 0; c < layout_.cells; ++c) {
    PetscInt *closure = nullptr, n_closure, n = 0;
    std::vector<PetscInt> points;
    const PetscInt **place_of; // [mesh point][dof]: its place as the cell sees it; null: as it is
    PetscCall(
        DMPlexComputeCellGeometryAffineFEM(dm_, first_cell_ + c, &v0_[3 * c], &J_[9 * c], &invJ_[9 * c], &detJ_[c]));
    PetscCall(DMPlexGetTransitiveClosure(dm_, first_cell_ + c, PETSC_TRUE, &n_closure, &closure));
    for (PetscInt f = 0; f < n_fields_; ++f) {
      PetscCall(PetscSectionGetFieldPointSyms(section, f, n_closure, closure, &place_of, nullptr));
      for (PetscInt i = 0; i < n_closure; ++i) {
        const PetscInt point = closure[2 * i];
        PetscInt dof, offset;
        PetscCall(PetscSectionGetFieldDof(section, point, f, &dof));
        PetscCall(PetscSectionGetFieldOffset(section, point, f, &offset));
        if (dof == 0) continue;
        auto place = std::find(points.begin(), points.end(), point);
        if (place == points.end()) place = points.insert(points.end(), point);
        PetscCheck(n + dof <= layout_.size, PETSC_COMM_SELF, PETSC_ERR_PLIB, "closure larger than the element");
        for (PetscInt d = 0; d < dof; ++d) {
          layout_.dofs[c * layout_.size + n + (place_of && place_of[i] ? place_of[i][d] : d)] = offset + d;
          if (c == 0) {
            layout_.point_of.push_back(static_cast<PetscInt>(place - points.begin()));
            layout_.field_of.push_back(f);
          }
        }
        n += dof;
      }
      PetscCall(PetscSectionRestoreFieldPointSyms(section, f, n_closure, closure, &place_of, nullptr));
    }
    PetscCall(DMPlexRestoreTransitiveClosure(dm_, first_cell_ + c, PETSC_TRUE, &n_closure, &closure));
    PetscCheck(n == layout_.size, PETSC_COMM_SELF, PETSC_ERR_PLIB, "closure smaller than the element");
    layout_.points = static_cast<PetscInt>(points.size());
    layout_.of_cell.insert(layout_.of_cell.end(), points.begin(), points.end());
  }

  PetscFE fe;
  PetscQuadrature rule;
  PetscInt Nq;
  const PetscReal *xi, *weights;
  PetscCall(PetscDSGetDiscretization(ds_, 0, (PetscObject *)&fe));
  PetscCall(PetscFEGetQuadrature(fe, &rule));
  PetscCall(PetscQuadratureGetData(rule, nullptr, nullptr, &Nq, &xi, &weights));
  std::vector<PetscReal> points(xi, xi + 3 * Nq);
  points.insert(points.end(), {-1, -1, -1, 1, -1, -1, -1, 1, -1, -1, -1, 1});
  watched_points_ = Nq + 4;
  PetscCall(watched_.setup(fe, points));
  watched_at_ = std::move(points);
  rule_weights_.assign(weights, weights + Nq);
  const PetscReal total = std::accumulate(weights, weights + Nq, PetscReal(0));
  for (PetscReal w : rule_weights_) relative_weights_.push_back(w / total);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::setup_facets()
{
  PetscInt n_boundaries, face_begin, face_end;
  PetscFE fe;
  PetscQuadrature rule;
  PetscDualSpace space;
  DM reference;
  const PetscInt *reference_faces;
  DMField coordinates;

  PetscFunctionBeginUser;
  PetscCall(PetscDSGetNumBoundary(ds_, &n_boundaries));
  PetscCall(DMPlexGetHeightStratum(dm_, 1, &face_begin, &face_end));
  PetscCall(PetscDSGetDiscretization(ds_, 0, (PetscObject *)&fe));
  PetscCall(PetscFEGetFaceQuadrature(fe, &rule));
  PetscCall(PetscFEGetDualSpace(fe, &space));
  PetscCall(PetscDualSpaceGetDM(space, &reference));
  PetscCall(DMPlexGetCone(reference, 0, &reference_faces));
  PetscCall(DMGetCoordinateField(dm_, &coordinates));
  for (PetscInt b = 0; b < n_boundaries; ++b) {
    DMBoundaryConditionType type;
    PetscWeakForm wf;
    DMLabel label;
    PetscInt n_values, field;
    const PetscInt *values;
    const char *surface;
    PetscCall(PetscDSGetBoundary(ds_, b, &wf, &type, nullptr, &label, &n_values, &values, &field, nullptr, nullptr,
                                 nullptr, nullptr, nullptr));
    if (type != DM_BC_NATURAL) continue;
    for (PetscInt v = 0; v < n_values; ++v) {
      ISHandle stratum, faces_is;
      PetscCall(DMLabelGetStratumIS(label, values[v], stratum.out()));
      if (!stratum) continue;
      PetscInt n;
      const PetscInt *points;
      std::vector<PetscInt> faces, cells;
      PetscCall(ISGetLocalSize(stratum, &n));
      PetscCall(ISGetIndices(stratum, &points));
      for (PetscInt i = 0; i < n; ++i) {
        const PetscInt *support;
        if (points[i] < face_begin || points[i] >= face_end) continue;
        PetscCall(DMPlexGetSupport(dm_, points[i], &support));
        faces.push_back(points[i]);
        cells.push_back(support[0] - first_cell_);
      }
      PetscCall(ISRestoreIndices(stratum, &points));
      if (faces.empty()) continue;
      auto *facets = new Facets;
      facets_.push_back(facets);
      facets->wf = wf;
      facets->key = {label, values[v], field, 0};
      PetscCall(PetscObjectGetName((PetscObject)label, &surface));
      facets->surface = surface;
      facets->points = faces;
      facets->cells = cells;
      PetscCall(
          ISCreateGeneral(PETSC_COMM_SELF, (PetscInt)faces.size(), faces.data(), PETSC_COPY_VALUES, faces_is.out()));
      PetscCall(compat::create_facet_geometry(coordinates, faces_is, rule, &facets->geom));
      // PETSc 3.18 gives the maps of the face itself. Gradients need the inverse map of the cell behind it (suppInvJ is
      // that of the face there), and x belongs to the basis functions, which are tabulated on the reference cell's
      // faces: set both from the cell.
      PetscFEGeom &g = *facets->geom;
      for (std::size_t i = 0; i < cells.size(); ++i) {
        PetscReal v0[3], R[9], inverse[9], det;
        PetscReal *x = g.v + i * g.numPoints * 3, *J = g.J + i * g.numPoints * 9;
        for (PetscInt q = 0; q < g.numPoints; ++q)
          std::copy_n(&invJ_[9 * cells[i]], 9, g.suppInvJ[0] + (i * g.numPoints + q) * 9);
        const PetscReal *cell_J = &J_[9 * cells[i]], *cell_v = &v0_[3 * cells[i]], origin[2] = {-1, -1};
        PetscCall(
            DMPlexComputeCellGeometryFEM(reference, reference_faces[g.face[i][0]], nullptr, v0, R, inverse, &det));
        for (int r = 0; r < 3; ++r) {
          x[r] = cell_v[r];
          for (int d = 0; d < 3; ++d) {
            PetscReal xi = v0[d] + 1; // the first rule point, seen from the corner (-1, -1, -1)
            for (int e = 0; e < 2; ++e) xi += R[3 * d + e] * ((g.xi ? g.xi[e] : -1) - origin[e]);
            x[r] += cell_J[3 * r + d] * xi;
          }
          for (int e = 0; e < 2; ++e)
            J[3 * r + e] = cell_J[3 * r] * R[e] + cell_J[3 * r + 1] * R[3 + e] + cell_J[3 * r + 2] * R[6 + e];
        }
      }
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscFEGeom Assembly::block_geometry(PetscInt begin, PetscInt n)
{
  static const PetscReal corner[3] = {-1, -1, -1};
  PetscFEGeom geom{};
  geom.xi = corner;
  geom.v = &v0_[3 * begin];
  geom.J = &J_[9 * begin];
  geom.invJ = &invJ_[9 * begin];
  geom.detJ = &detJ_[begin];
  geom.dim = geom.dimEmbed = 3;
  geom.numCells = n;
  geom.numPoints = 1;
  geom.isAffine = PETSC_TRUE;
  return geom;
}

template <class OnCells, class OnFacets, class Scatter>
PetscErrorCode Assembly::for_blocks(Part part, Vec x, Vec x_t, PetscInt result_size, OnCells &&on_cells,
                                    OnFacets &&on_facets, Scatter &&scatter)
{
  const std::size_t n_coefficients = static_cast<std::size_t>(block_cells * layout_.size);
  std::vector<PetscScalar> u(n_coefficients), u_t(n_coefficients);
  std::vector<PetscScalar> results(static_cast<std::size_t>(block_cells * result_size));

  PetscFunctionBeginUser;
  const ReadArray xs(x), xts(x_t);
  const auto gather = [&](PetscInt i, PetscInt cell) {
    const PetscInt *dofs = cell_dofs(cell);
    for (PetscInt k = 0; k < layout_.size; ++k) {
      u[i * layout_.size + k] = xs[dofs[k]];
      u_t[i * layout_.size + k] = xts[dofs[k]];
    }
  };
  const PetscInt n_cells = part == Part::all ? layout_.cells : 0, most = places_per_call();
  for (PetscInt begin = 0, block = 0; begin < n_cells; begin += most, ++block) {
    const PetscInt n = std::min(most, n_cells - begin);
    PetscFEGeom geom = block_geometry(begin, n);
    for (PetscInt i = 0; i < n; ++i) gather(i, begin + i);
    std::fill(results.begin(), results.end(), 0.0);
    log_.timing = block % timed_share == 0;
    if (log_.timing) log_.timed_cells += n;
    PetscCall(put_places(cell_constants_, "", begin));
    PetscCall(on_cells(n, &geom, u.data(), u_t.data(), results.data()));
    for (PetscInt i = 0; i < n; ++i) PetscCall(scatter(begin + i, ElementOf::cell, &results[i * result_size]));
  }
  log_.timing = true;
  for (const Facets *facets : facets_) {
    const auto total = static_cast<PetscInt>(facets->cells.size());
    for (PetscInt begin = 0; begin < total; begin += most) {
      const PetscInt n = std::min(most, total - begin);
      PetscFEGeom *chunk = nullptr;
      for (PetscInt i = 0; i < n; ++i) gather(i, facets->cells[begin + i]);
      std::fill(results.begin(), results.end(), 0.0);
      PetscCall(PetscFEGeomGetChunk(facets->geom, begin, begin + n, &chunk));
      PetscCall(put_places(facets->constants, facets->surface, begin));
      PetscCall(on_facets(*facets, n, chunk, u.data(), u_t.data(), results.data()));
      PetscCall(PetscFEGeomRestoreChunk(facets->geom, begin, begin + n, &chunk));
      for (PetscInt i = 0; i < n; ++i)
        PetscCall(scatter(facets->cells[begin + i], ElementOf::facet, &results[i * result_size]));
    }
  }
  log_.timing = false;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Other types of PetscFE know one set of constants for all places of a call.
PetscInt Assembly::places_per_call() const
{
  return rate_ds_ && (!places_.offsets.empty() || memory_) ? 1 : block_cells;
}

/// Lets the next call find what is its places' own: cells, or the facets of @p surface; the first of them is @p begin.
PetscErrorCode Assembly::put_places(const std::vector<PetscReal> &rows, const std::string &surface, PetscInt begin)
{
  const std::size_t n = places_.offsets.size();
  PetscInt n_constants;
  const PetscScalar *constants;

  PetscFunctionBeginUser;
  const PointMemory::Room *room = memory_ ? memory_->room(surface) : nullptr;
  if (memory_) {
    places_.memory = room ? room->at(begin, 0) : Memory();
    places_.memory_width = room ? room->width() : 0;
  }
  if (n > 0) places_.rows = &rows[static_cast<std::size_t>(begin) * n];
  if (places_per_call() > 1) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscDSGetConstants(ds_, &n_constants, &constants));
  std::vector<PetscScalar> local(constants, constants + n_constants);
  for (std::size_t k = 0; k < n; ++k) local[static_cast<std::size_t>(places_.offsets[k])] = places_.rows[k];
  if (memory_) {
    place_memory_.first = places_.memory;
    place_memory_.width = places_.memory_width;
    if (room) room->coordinates(begin, place_memory_.x);
    local[static_cast<std::size_t>(place_memory_constant_)] = constants::to_scalar<const PlaceMemory *>(&place_memory_);
  }
  PetscCall(PetscDSSetConstants(ds_, n_constants, local.data()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

template <class Scatter>
PetscErrorCode Assembly::for_vectors(Part part, PetscReal t, Vec x, Vec x_t, Scatter &&scatter)
{
  PetscFunctionBeginUser;
  const auto on_cells = [&](PetscInt n, PetscFEGeom *geom, const PetscScalar *u, const PetscScalar *u_t,
                            PetscScalar *vectors) -> PetscErrorCode {
    PetscFunctionBeginUser;
    for (PetscInt field = 0; field < n_fields_; ++field)
      PetscCall(PetscFEIntegrateResidual(ds_, {nullptr, 0, field, 0}, n, geom, u, u_t, rate_ds_, u_t, t, vectors));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  const auto on_facets = [&](const Facets &facets, PetscInt n, PetscFEGeom *geom, const PetscScalar *u,
                             const PetscScalar *u_t, PetscScalar *vectors) -> PetscErrorCode {
    PetscFunctionBeginUser;
    PetscCall(PetscFEIntegrateBdResidual(ds_, facets.wf, facets.key, n, geom, u, u_t, rate_ds_, u_t, t, vectors));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscCall(for_blocks(part, x, x_t, layout_.size, on_cells, on_facets, scatter));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::residual(Part part, PetscReal t, Vec x, Vec x_t, const PetscReal row_scale[], Vec F)
{
  PetscFunctionBeginUser;
  WriteArray f(F);
  const auto scatter = [&](PetscInt cell, ElementOf, const PetscScalar *vector) -> PetscErrorCode {
    const PetscInt *dofs = cell_dofs(cell);
    for (PetscInt i = 0; i < layout_.size; ++i) f[dofs[i]] += row_scale[layout_.field_of[i]] * vector[i];
    return PETSC_SUCCESS;
  };
  PetscCall(for_vectors(part, t, x, x_t, scatter));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::weighted_residual(Part part, PetscReal t, Vec x, Vec x_t, const PetscReal row_scale[],
                                           const std::vector<Vec> &weights, std::vector<std::vector<PetscReal>> &sums)
{
  std::vector<std::unique_ptr<ReadArray>> arrays;

  PetscFunctionBeginUser;
  for (const Vec weight : weights) arrays.push_back(std::make_unique<ReadArray>(weight));
  sums.assign(weights.size(), std::vector<PetscReal>(static_cast<std::size_t>(layout_.cells), 0));
  const auto scatter = [&](PetscInt cell, ElementOf, const PetscScalar *vector) -> PetscErrorCode {
    const PetscInt *dofs = cell_dofs(cell);
    for (std::size_t k = 0; k < weights.size(); ++k)
      for (PetscInt i = 0; i < layout_.size; ++i)
        sums[k][static_cast<std::size_t>(cell)] += row_scale[layout_.field_of[i]] * vector[i] * (*arrays[k])[dofs[i]];
    return PETSC_SUCCESS;
  };
  PetscCall(for_vectors(part, t, x, x_t, scatter));
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Assembly::change_varying(std::size_t which, PetscReal change)
{
  const std::size_t n = places_.offsets.size();
  for (std::size_t i = which; i < cell_constants_.size(); i += n) cell_constants_[i] += change;
  for (Facets *facets : facets_)
    for (std::size_t i = which; i < facets->constants.size(); i += n) facets->constants[i] += change;
}

template <class Scatter>
PetscErrorCode Assembly::for_matrices(Part part, PetscReal t, Vec x, Vec x_t, PetscReal shift, Scatter &&scatter)
{
  PetscFunctionBeginUser;
  const auto on_cells = [&](PetscInt n, PetscFEGeom *geom, const PetscScalar *u, const PetscScalar *u_t,
                            PetscScalar *matrices) -> PetscErrorCode {
    PetscFunctionBeginUser;
    for (PetscInt pair = 0; pair < n_fields_ * n_fields_; ++pair)
      PetscCall(compat::integrate_jacobian(PetscFEIntegrateJacobian, ds_, {nullptr, 0, pair, 0}, n, geom, u, u_t,
                                           rate_ds_, t, shift, matrices));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  const auto on_facets = [&](const Facets &facets, PetscInt n, PetscFEGeom *geom, const PetscScalar *u,
                             const PetscScalar *u_t, PetscScalar *matrices) -> PetscErrorCode {
    PetscFunctionBeginUser;
    for (PetscInt trial = 0; trial < n_fields_; ++trial) {
      PetscFormKey key = facets.key;
      key.field = facets.key.field * n_fields_ + trial;
      PetscCall(compat::integrate_bd_jacobian(PetscFEIntegrateBdJacobian, ds_, facets.wf, key, n, geom, u, u_t,
                                              rate_ds_, t, shift, matrices));
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscCall(for_blocks(part, x, x_t, layout_.size * layout_.size, on_cells, on_facets, scatter));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::jacobian(Part part, PetscReal t, Vec x, Vec x_t, PetscReal shift, const PetscReal row_scale[],
                                  Mat A, const std::vector<CellMatrices *> &also)
{
  PetscFunctionBeginUser;
  PetscCall(map_.setup(dm_, layout_, A));
  if (part == Part::all) PetscCall(MatZeroEntries(A));
  PetscCall(map_.begin());
  const auto scatter = [&](PetscInt cell, ElementOf what, const PetscScalar *matrix) -> PetscErrorCode {
    PetscFunctionBeginHot;
    PetscCall(map_.add(cell, matrix, row_scale, A));
    for (CellMatrices *other : also) PetscCall(other->add(cell, what, matrix, row_scale, false));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscCall(for_matrices(part, t, x, x_t, shift, scatter));
  PetscCall(map_.end(A));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::transposed_jacobian(PetscReal t, Vec x, Vec x_t, PetscReal shift, const PetscReal row_scale[],
                                             Mat A, const std::vector<CellMatrices *> &also)
{
  const PetscInt size = layout_.size;
  const std::vector<PetscReal> unscaled(static_cast<std::size_t>(n_fields_), 1);
  std::vector<PetscScalar> transposed(static_cast<std::size_t>(size * size));

  PetscFunctionBeginUser;
  PetscCall(map_.setup(dm_, layout_, A));
  PetscCall(MatZeroEntries(A));
  PetscCall(map_.begin());
  const auto scatter = [&](PetscInt cell, ElementOf what, const PetscScalar *matrix) -> PetscErrorCode {
    PetscFunctionBeginHot;
    for (PetscInt i = 0; i < size; ++i)
      for (PetscInt j = 0; j < size; ++j)
        transposed[j * size + i] = row_scale[layout_.field_of[i]] * matrix[i * size + j];
    PetscCall(map_.add(cell, transposed.data(), unscaled.data(), A));
    for (CellMatrices *other : also) PetscCall(other->add(cell, what, matrix, row_scale, true));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscCall(for_matrices(Part::all, t, x, x_t, shift, scatter));
  PetscCall(map_.end(A));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::add_transposed_product(PetscReal t, Vec x, Vec x_t, PetscReal shift,
                                                const PetscReal row_scale[], Vec z, Vec y)
{
  PetscFunctionBeginUser;
  const ReadArray zs(z);
  WriteArray ys(y);
  const auto scatter = [&](PetscInt cell, ElementOf, const PetscScalar *matrix) -> PetscErrorCode {
    const PetscInt *dofs = cell_dofs(cell);
    for (PetscInt i = 0; i < layout_.size; ++i) {
      const PetscScalar weight = row_scale[layout_.field_of[i]] * zs[dofs[i]];
      for (PetscInt j = 0; j < layout_.size; ++j) ys[dofs[j]] += weight * matrix[i * layout_.size + j];
    }
    return PETSC_SUCCESS;
  };
  PetscCall(for_matrices(Part::all, t, x, x_t, shift, scatter));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::cell_matrices(PetscReal t, Vec x, Vec x_t, PetscReal shift, const TakeMatrix &take)
{
  PetscFunctionBeginUser;
  const auto scatter = [&](PetscInt cell, ElementOf, const PetscScalar *matrix) { return take(cell, matrix); };
  PetscCall(for_matrices(Part::all, t, x, x_t, shift, scatter));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
