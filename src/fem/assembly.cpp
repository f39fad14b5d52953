#include "pulmo/fem/assembly.hpp"

#include "pulmo/base/simd.hpp"
#include "pulmo/fem/point_memory.hpp"
#include "pulmo/physics/parameter_fields.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace pulmo {

/// The facets of one boundary of the PetscDS.
struct Assembly::Facets {
  PetscWeakForm wf = nullptr;
  PetscFormKey key{};
  std::vector<PetscInt> cells;      ///< the cell behind each facet
  std::vector<PetscReal> constants; ///< [facet][those that differ from place to place]
  PetscFEGeom *geom = nullptr;

  ~Facets() { (void)PetscFEGeomDestroy(&geom); }
};

/// Where the entries of element matrices go in a sparse matrix. Dofs of one mesh point are neighbours in every
/// row, and all rows of a mesh point have the same pattern: one offset per pair of mesh points of a cell is enough.
struct Assembly::MatrixMap {
  PetscObjectId matrix = 0; ///< which matrix: an address may be used again
  bool direct = false;      ///< AIJ: entries are added in place
  Mat diagonal = nullptr, off_diagonal = nullptr;
  const PetscInt *row_begin[2] = {nullptr, nullptr}; ///< CSR row pointers of the two parts
  PetscScalar *values[2] = {nullptr, nullptr};       ///< their entries, while a Jacobian is assembled
  std::vector<std::int32_t> offset;                  ///< [cell][row point][column point]
  std::vector<PetscInt> global;                      ///< [local dof]: global number of a free dof, -1 if constrained
  std::vector<PetscInt> row;                         ///< [local dof]: owned: local row; ghost: -(ghost row) - 1
  std::vector<std::int8_t> free_index; ///< [local dof]: place among the free dofs of its mesh point, -1 constrained
  std::vector<std::uint8_t> owned;     ///< [mesh point]
  // rows of other ranks, summed here and sent once
  std::vector<PetscInt> ghost_begin, ghost_columns, ghost_rows;
  std::vector<PetscScalar> ghost_values;
};

Assembly::~Assembly()
{
  for (Facets *f : facets_) delete f;
  delete map_;
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
  PetscFunctionBeginUser;
  memory_ = &memory;
  places_.memory_width = memory.width();
  PetscCall(PlaceData::attach(ds_, &places_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::setup_varying(const ParameterFields &fields)
{
  PetscFunctionBeginUser;
  places_.offsets = fields.offsets();
  for (PetscInt c = 0; c < cells_; ++c) fields.append(c, "", cell_constants_);
  for (Facets *facets : facets_) {
    const char *surface;
    PetscCall(PetscObjectGetName((PetscObject)facets->key.label, &surface));
    for (const PetscInt cell : facets->cells) fields.append(cell, surface, facets->constants);
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
  cells_ = last - first_cell_;
  PetscCall(PetscDSGetTotalDimension(ds_, &element_size_));
  cell_dofs_.resize(static_cast<std::size_t>(cells_ * element_size_));
  v0_.resize(3 * cells_);
  J_.resize(9 * cells_);
  invJ_.resize(9 * cells_);
  detJ_.resize(cells_);
  for (PetscInt c = 0; c < cells_; ++c) {
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
        PetscCheck(n + dof <= element_size_, PETSC_COMM_SELF, PETSC_ERR_PLIB, "closure larger than the element");
        for (PetscInt d = 0; d < dof; ++d) {
          cell_dofs_[c * element_size_ + n + (place_of && place_of[i] ? place_of[i][d] : d)] = offset + d;
          if (c == 0) {
            dof_point_.push_back(static_cast<PetscInt>(place - points.begin()));
            dof_field_.push_back(f);
          }
        }
        n += dof;
      }
      PetscCall(PetscSectionRestoreFieldPointSyms(section, f, n_closure, closure, &place_of, nullptr));
    }
    PetscCall(DMPlexRestoreTransitiveClosure(dm_, first_cell_ + c, PETSC_TRUE, &n_closure, &closure));
    PetscCheck(n == element_size_, PETSC_COMM_SELF, PETSC_ERR_PLIB, "closure smaller than the element");
    points_per_cell_ = static_cast<PetscInt>(points.size());
    cell_points_.insert(cell_points_.end(), points.begin(), points.end());
  }

  // where J is watched: the quadrature points, then the corners of the reference cell
  PetscFE fe;
  PetscQuadrature rule;
  PetscInt Nq;
  const PetscReal *xi, *weights;
  PetscTabulation T;
  PetscCall(PetscDSGetDiscretization(ds_, 0, (PetscObject *)&fe));
  PetscCall(PetscFEGetQuadrature(fe, &rule));
  PetscCall(PetscQuadratureGetData(rule, nullptr, nullptr, &Nq, &xi, &weights));
  std::vector<PetscReal> samples(xi, xi + 3 * Nq);
  samples.insert(samples.end(), {-1, -1, -1, 1, -1, -1, -1, 1, -1, -1, -1, 1});
  sample_points_ = Nq + 4;
  sample_weights_.assign(weights, weights + Nq);
  const PetscReal total = std::accumulate(weights, weights + Nq, PetscReal(0));
  for (PetscReal w : sample_weights_) relative_weights_.push_back(w / total);
  PetscCall(PetscFECreateTabulation(fe, 1, sample_points_, samples.data(), 1, &T));
  nodes_ = T->Nb / T->Nc;
  PetscCheck(nodes_ <= max_nodes, PETSC_COMM_SELF, PETSC_ERR_SUP, "elements with more than %d nodes", max_nodes);
  for (PetscInt q = 0; q < sample_points_; ++q)
    for (PetscInt a = 0; a < nodes_; ++a)
      for (PetscInt d = 0; d < 3; ++d) sample_gradients_.push_back(T->T[1][((q * T->Nb + a * T->Nc) * T->Nc) * 3 + d]);
  PetscCall(PetscTabulationDestroy(&T));
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
  const std::size_t n_coefficients = static_cast<std::size_t>(block_cells * element_size_);
  std::vector<PetscScalar> u(n_coefficients), u_t(n_coefficients);
  std::vector<PetscScalar> results(static_cast<std::size_t>(block_cells * result_size));

  PetscFunctionBeginUser;
  const ReadArray xs(x), xts(x_t);
  const auto gather = [&](PetscInt i, PetscInt cell) {
    const PetscInt *dofs = cell_dofs(cell);
    for (PetscInt k = 0; k < element_size_; ++k) {
      u[i * element_size_ + k] = xs[dofs[k]];
      u_t[i * element_size_ + k] = xts[dofs[k]];
    }
  };
  const PetscInt n_cells = part == Part::all ? cells_ : 0, most = places_per_call();
  for (PetscInt begin = 0, block = 0; begin < n_cells; begin += most, ++block) {
    const PetscInt n = std::min(most, n_cells - begin);
    PetscFEGeom geom = block_geometry(begin, n);
    for (PetscInt i = 0; i < n; ++i) gather(i, begin + i);
    std::fill(results.begin(), results.end(), 0.0);
    log_.timing = block % timed_share == 0;
    if (log_.timing) log_.timed_cells += n;
    PetscCall(put_places(cell_constants_, true, begin));
    PetscCall(on_cells(n, &geom, u.data(), u_t.data(), results.data()));
    for (PetscInt i = 0; i < n; ++i) PetscCall(scatter(begin + i, &results[i * result_size]));
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
      PetscCall(put_places(facets->constants, false, begin));
      PetscCall(on_facets(*facets, n, chunk, u.data(), u_t.data(), results.data()));
      PetscCall(PetscFEGeomRestoreChunk(facets->geom, begin, begin + n, &chunk));
      for (PetscInt i = 0; i < n; ++i) PetscCall(scatter(facets->cells[begin + i], &results[i * result_size]));
    }
  }
  log_.timing = false;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Other types of PetscFE know one set of constants for all places of a call.
PetscInt Assembly::places_per_call() const
{
  return rate_ds_ && !places_.offsets.empty() ? 1 : block_cells;
}

/// Lets the next call find what is its places' own; the first of them is @p begin.
PetscErrorCode Assembly::put_places(const std::vector<PetscReal> &rows, bool cells, PetscInt begin)
{
  const std::size_t n = places_.offsets.size();
  PetscInt n_constants;
  const PetscScalar *constants;

  PetscFunctionBeginUser;
  if (memory_) places_.memory = cells ? memory_->at(begin, 0) : Memory();
  if (n == 0) PetscFunctionReturn(PETSC_SUCCESS);
  places_.rows = &rows[static_cast<std::size_t>(begin) * n];
  if (places_per_call() > 1) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscDSGetConstants(ds_, &n_constants, &constants));
  std::vector<PetscScalar> local(constants, constants + n_constants);
  for (std::size_t k = 0; k < n; ++k) local[static_cast<std::size_t>(places_.offsets[k])] = places_.rows[k];
  PetscCall(PetscDSSetConstants(ds_, n_constants, local.data()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::residual(Part part, PetscReal t, Vec x, Vec x_t, const PetscReal row_scale[], Vec F)
{
  PetscFunctionBeginUser;
  WriteArray f(F);
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
  const auto scatter = [&](PetscInt cell, const PetscScalar *vector) -> PetscErrorCode {
    const PetscInt *dofs = cell_dofs(cell);
    for (PetscInt i = 0; i < element_size_; ++i) f[dofs[i]] += row_scale[dof_field_[i]] * vector[i];
    return PETSC_SUCCESS;
  };
  PetscCall(for_blocks(part, x, x_t, element_size_, on_cells, on_facets, scatter));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::jacobian(Part part, PetscReal t, Vec x, Vec x_t, PetscReal shift, const PetscReal row_scale[],
                                  Mat A, CellMatrices *also)
{
  PetscFunctionBeginUser;
  PetscCall(map_matrix(A));
  if (part == Part::all) PetscCall(MatZeroEntries(A));
  std::fill(map_->ghost_values.begin(), map_->ghost_values.end(), 0.0);
  if (map_->diagonal) PetscCall(MatSeqAIJGetArray(map_->diagonal, &map_->values[0]));
  if (map_->off_diagonal) PetscCall(MatSeqAIJGetArray(map_->off_diagonal, &map_->values[1]));
  const auto on_cells = [&](PetscInt n, PetscFEGeom *geom, const PetscScalar *u, const PetscScalar *u_t,
                            PetscScalar *matrices) -> PetscErrorCode {
    PetscFunctionBeginUser;
    for (PetscInt pair = 0; pair < n_fields_ * n_fields_; ++pair)
      PetscCall(compat::integrate_jacobian(PetscFEIntegrateJacobian, ds_, {nullptr, 0, pair, 0}, n, geom, u, u_t,
                                           rate_ds_, t, shift, matrices));
    const auto begin = static_cast<PetscInt>((geom->detJ - detJ_.data()));
    for (PetscInt i = 0; also && i < n; ++i)
      PetscCall(also->add(begin + i, matrices + i * element_size_ * element_size_, row_scale));
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
  const auto scatter = [&](PetscInt cell, const PetscScalar *matrix) {
    return add_to_matrix(cell, matrix, row_scale, A);
  };
  PetscCall(for_blocks(part, x, x_t, element_size_ * element_size_, on_cells, on_facets, scatter));
  if (map_->diagonal) PetscCall(MatSeqAIJRestoreArray(map_->diagonal, &map_->values[0]));
  if (map_->off_diagonal) PetscCall(MatSeqAIJRestoreArray(map_->off_diagonal, &map_->values[1]));
  for (std::size_t r = 0; r < map_->ghost_rows.size(); ++r) {
    const PetscInt n = map_->ghost_begin[r + 1] - map_->ghost_begin[r];
    PetscCall(MatSetValues(A, 1, &map_->ghost_rows[r], n, &map_->ghost_columns[map_->ghost_begin[r]],
                           &map_->ghost_values[map_->ghost_begin[r]], ADD_VALUES));
  }
  PetscCall(MatAssemblyBegin(A, MAT_FINAL_ASSEMBLY));
  PetscCall(MatAssemblyEnd(A, MAT_FINAL_ASSEMBLY));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::map_matrix(Mat A)
{
  PetscObjectId id;
  PetscSection section, global;
  PetscInt point_begin, point_end, n_local, row_begin, row_end;
  PetscBool seq, mpi;
  const PetscInt *garray = nullptr, *columns[2] = {nullptr, nullptr};
  PetscInt n_garray = 0;

  PetscFunctionBeginUser;
  PetscCall(PetscObjectGetId((PetscObject)A, &id));
  if (map_ && map_->matrix == id) PetscFunctionReturn(PETSC_SUCCESS);
  delete map_;
  map_ = new MatrixMap;
  MatrixMap &m = *map_;
  m.matrix = id;
  PetscCall(DMGetLocalSection(dm_, &section));
  PetscCall(DMGetGlobalSection(dm_, &global));
  PetscCall(PetscSectionGetChart(section, &point_begin, &point_end));
  PetscCall(PetscSectionGetStorageSize(section, &n_local));
  PetscCall(MatGetOwnershipRange(A, &row_begin, &row_end));
  PetscCall(PetscObjectTypeCompare((PetscObject)A, MATSEQAIJ, &seq));
  PetscCall(PetscObjectTypeCompare((PetscObject)A, MATMPIAIJ, &mpi));
  m.direct = seq || mpi;

  // free dofs and their global numbers
  m.global.assign(n_local, -1);
  m.row.assign(n_local, 0);
  m.free_index.assign(n_local, -1);
  m.owned.assign(point_end, 0);
  std::vector<PetscInt> first_free(point_end, 0), n_free(point_end, 0); // global number of the first, count
  for (PetscInt p = point_begin; p < point_end; ++p) {
    PetscInt dof, offset, constrained, first, k = 0;
    const PetscInt *which = nullptr;
    PetscCall(PetscSectionGetDof(section, p, &dof));
    if (dof == 0) continue;
    PetscCall(PetscSectionGetOffset(section, p, &offset));
    PetscCall(PetscSectionGetConstraintDof(section, p, &constrained));
    if (constrained) PetscCall(PetscSectionGetConstraintIndices(section, p, &which));
    PetscCall(PetscSectionGetOffset(global, p, &first));
    m.owned[p] = first >= 0;
    if (first < 0) first = -(first + 1);
    first_free[p] = first;
    for (PetscInt d = 0; d < dof; ++d) {
      if (std::find(which, which + constrained, d) != which + constrained) continue;
      m.free_index[offset + d] = static_cast<std::int8_t>(k);
      m.global[offset + d] = first + k;
      m.row[offset + d] = first + k - row_begin;
      ++k;
    }
    n_free[p] = k;
  }
  if (!m.direct) PetscFunctionReturn(PETSC_SUCCESS);

  m.diagonal = A;
  if (mpi) {
    PetscCall(MatMPIAIJGetSeqAIJ(A, &m.diagonal, &m.off_diagonal, &garray));
    PetscCall(MatGetSize(m.off_diagonal, nullptr, &n_garray));
  }
  PetscInt n_rows;
  PetscBool done;
  PetscCall(MatGetRowIJ(m.diagonal, 0, PETSC_FALSE, PETSC_FALSE, &n_rows, &m.row_begin[0], &columns[0], &done));
  if (mpi)
    PetscCall(MatGetRowIJ(m.off_diagonal, 0, PETSC_FALSE, PETSC_FALSE, &n_rows, &m.row_begin[1], &columns[1], &done));

  // ghost rows: their columns are the free dofs of all mesh points that share a cell with them
  std::map<PetscInt, std::map<PetscInt, std::int32_t>> ghosts; // row point -> column point -> offset in the row
  for (PetscInt c = 0; c < cells_; ++c) {
    const PetscInt *points = &cell_points_[c * points_per_cell_];
    for (PetscInt i = 0; i < points_per_cell_; ++i)
      if (!m.owned[points[i]])
        for (PetscInt j = 0; j < points_per_cell_; ++j) ghosts[points[i]][points[j]] = 0;
  }
  m.ghost_begin.push_back(0);
  for (auto &[point, row] : ghosts) {
    PetscInt offset, dof, length = 0;
    std::vector<PetscInt> row_columns;
    for (auto &[column, place] : row) {
      place = static_cast<std::int32_t>(length);
      for (PetscInt k = 0; k < n_free[column]; ++k) row_columns.push_back(first_free[column] + k);
      length += n_free[column];
    }
    PetscCall(PetscSectionGetOffset(section, point, &offset));
    PetscCall(PetscSectionGetDof(section, point, &dof));
    for (PetscInt d = 0; d < dof; ++d) {
      if (m.free_index[offset + d] < 0) continue;
      m.row[offset + d] = -static_cast<PetscInt>(m.ghost_rows.size()) - 1;
      m.ghost_rows.push_back(m.global[offset + d]);
      m.ghost_columns.insert(m.ghost_columns.end(), row_columns.begin(), row_columns.end());
      m.ghost_begin.push_back(static_cast<PetscInt>(m.ghost_columns.size()));
    }
  }
  m.ghost_values.assign(m.ghost_columns.size(), 0);

  // offsets of column points within the rows of row points
  m.offset.resize(static_cast<std::size_t>(cells_) * points_per_cell_ * points_per_cell_);
  for (PetscInt c = 0; c < cells_; ++c) {
    const PetscInt *points = &cell_points_[c * points_per_cell_];
    for (PetscInt i = 0; i < points_per_cell_; ++i) {
      for (PetscInt j = 0; j < points_per_cell_; ++j) {
        std::int32_t &offset = m.offset[(c * points_per_cell_ + i) * points_per_cell_ + j];
        offset = 0;
        if (n_free[points[i]] == 0 || n_free[points[j]] == 0) continue;
        if (!m.owned[points[i]]) {
          offset = ghosts[points[i]][points[j]];
          continue;
        }
        const int part = m.owned[points[j]] ? 0 : 1;
        PetscInt column = first_free[points[j]];
        if (part == 0)
          column -= row_begin;
        else {
          const PetscInt *place = std::lower_bound(garray, garray + n_garray, column);
          PetscCheck(place < garray + n_garray && *place == column, PETSC_COMM_SELF, PETSC_ERR_PLIB,
                     "the matrix lacks a column of a neighbouring rank");
          column = static_cast<PetscInt>(place - garray);
        }
        const PetscInt row = first_free[points[i]] - row_begin;
        const PetscInt *begin = columns[part] + m.row_begin[part][row],
                       *end = columns[part] + m.row_begin[part][row + 1];
        const PetscInt *place = std::lower_bound(begin, end, column);
        PetscCheck(place < end && *place == column, PETSC_COMM_SELF, PETSC_ERR_PLIB,
                   "the matrix pattern lacks an entry of the element matrices");
        offset = static_cast<std::int32_t>(place - begin);
      }
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::add_to_matrix(PetscInt cell, const PetscScalar *matrix, const PetscReal row_scale[], Mat A)
{
  constexpr PetscInt max_size = 128;
  MatrixMap &m = *map_;
  const PetscInt *dofs = cell_dofs(cell), *points = &cell_points_[cell * points_per_cell_];

  PetscFunctionBeginHot;
  PetscCheck(element_size_ <= max_size, PETSC_COMM_SELF, PETSC_ERR_SUP, "elements with more than %d dofs",
             (int)max_size);
  if (!m.direct) {
    PetscScalar scaled[max_size];
    PetscInt columns[max_size];
    for (PetscInt i = 0; i < element_size_; ++i) columns[i] = m.global[dofs[i]];
    for (PetscInt i = 0; i < element_size_; ++i) {
      for (PetscInt j = 0; j < element_size_; ++j) scaled[j] = row_scale[dof_field_[i]] * matrix[i * element_size_ + j];
      PetscCall(MatSetValues(A, 1, &columns[i], element_size_, columns, scaled, ADD_VALUES));
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  // free columns, first those of this rank, then the others
  PetscInt columns[max_size], n_columns[2] = {0, 0};
  for (int part = 0, n = 0; part < 2; ++part) {
    for (PetscInt j = 0; j < element_size_; ++j)
      if (m.free_index[dofs[j]] >= 0 && (m.owned[points[dof_point_[j]]] ? 0 : 1) == part) columns[n++] = j;
    n_columns[part] = n;
  }
  PetscInt place[max_size], current = -1;
  for (PetscInt i = 0; i < element_size_; ++i) {
    if (m.free_index[dofs[i]] < 0) continue;
    const PetscInt point = dof_point_[i];
    if (point != current) {
      const std::int32_t *offset = &m.offset[(cell * points_per_cell_ + point) * points_per_cell_];
      for (PetscInt k = 0; k < n_columns[1]; ++k) {
        const PetscInt j = columns[k];
        place[k] = offset[dof_point_[j]] + m.free_index[dofs[j]];
      }
      current = point;
    }
    const PetscScalar *entries = matrix + i * element_size_, scale = row_scale[dof_field_[i]];
    const PetscInt row = m.row[dofs[i]];
    if (row < 0) {
      PetscScalar *target = &m.ghost_values[m.ghost_begin[-row - 1]];
      for (PetscInt k = 0; k < n_columns[1]; ++k) target[place[k]] += scale * entries[columns[k]];
    } else {
      PetscScalar *target = m.values[0] + m.row_begin[0][row];
      for (PetscInt k = 0; k < n_columns[0]; ++k) target[place[k]] += scale * entries[columns[k]];
      if (n_columns[1] > n_columns[0]) {
        target = m.values[1] + m.row_begin[1][row];
        for (PetscInt k = n_columns[0]; k < n_columns[1]; ++k) target[place[k]] += scale * entries[columns[k]];
      }
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Displacements of the nodes of a cell; the fourth entry is zero.
struct NodeDisplacements {
  Vector4 of[max_nodes];
  Vector4 &operator[](PetscInt a) { return of[a]; }
  const Vector4 &operator[](PetscInt a) const { return of[a]; }
};

static void gather_displacements(const PetscInt *dofs, PetscInt nodes, const PetscScalar *x, NodeDisplacements &u)
{
  for (PetscInt a = 0; a < nodes; ++a) u[a] = Vector4{x[dofs[3 * a]], x[dofs[3 * a + 1]], x[dofs[3 * a + 2]], 0};
}

/// Grad u at a sample point, with @p D the derivatives of the basis there, from the cell's displacements.
static void sample_gradient(const PetscReal *D, const PetscReal *inverse, PetscInt nodes, const NodeDisplacements &u,
                            PetscScalar H[9])
{
  Vector4 along[3] = {}; // the axes of the reference cell
  for (PetscInt a = 0; a < nodes; ++a)
    for (int g = 0; g < 3; ++g) along[g] += D[3 * a + g] * u[a];
  for (int d = 0; d < 3; ++d) {
    const Vector4 h = along[0] * inverse[d] + along[1] * inverse[3 + d] + along[2] * inverse[6 + d];
    for (int i = 0; i < 3; ++i) H[3 * i + d] = h[i];
  }
}

void Assembly::point_states(PetscInt c, const PetscScalar *x, std::vector<PointState> &states) const
{
  NodeDisplacements u;
  states.resize(sample_points_);
  gather_displacements(cell_dofs(c), nodes_, x, u);
  for (PetscInt q = 0; q < sample_points_; ++q) {
    PetscScalar H[9];
    sample_gradient(&sample_gradients_[q * nodes_ * 3], &invJ_[9 * c], nodes_, u, H);
    make_point_state(H, nullptr, states[q]);
  }
}

PetscErrorCode Assembly::measure(Vec x, Measures &measures) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  const auto n_rule = static_cast<PetscInt>(sample_weights_.size());
  struct {
    double value;
    int rank;
  } least{PETSC_MAX_REAL, 0}, winner;
  double volume = 0, extremes[2] = {-PETSC_MAX_REAL, -PETSC_MAX_REAL}; // max J, -(min J at points)
  PetscInt where = -1;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &least.rank));
  const ReadArray xs(x);
  for (PetscInt c = 0; c < cells_; ++c) {
    NodeDisplacements u;
    gather_displacements(cell_dofs(c), nodes_, xs.data(), u);
    double sum = 0;
    for (PetscInt q = 0; q < sample_points_; ++q) {
      PetscScalar H[9];
      sample_gradient(&sample_gradients_[q * nodes_ * 3], &invJ_[9 * c], nodes_, u, H);
      const double Jm1 = jacobian_minus_one(H), J = 1 + Jm1;
      extremes[0] = std::max(extremes[0], J);
      if (q < n_rule) {
        sum += sample_weights_[q] * Jm1;
        extremes[1] = std::max(extremes[1], std::isnan(J) ? PETSC_MAX_REAL : -J);
      }
      if (!(J >= least.value)) { // also taken when J is not a number
        least.value = std::isnan(J) ? -PETSC_MAX_REAL : J;
        where = c;
      }
    }
    volume += sum * detJ_[c];
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &volume, 1, MPI_DOUBLE, MPI_SUM, comm));
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, extremes, 2, MPI_DOUBLE, MPI_MAX, comm));
  PetscCallMPI(MPI_Allreduce(&least, &winner, 1, MPI_DOUBLE_INT, MPI_MINLOC, comm));
  measures.volume_change = volume;
  measures.max_J = extremes[0];
  measures.min_J_points = -extremes[1];
  measures.min_J = winner.value;
  measures.rank = winner.rank;
  measures.cell = where;
  if (winner.rank == least.rank && where >= 0)
    for (int d = 0; d < 3; ++d) // reference coordinates of the centroid are -1/2
      measures.where[d] =
          v0_[3 * where + d] + (J_[9 * where + 3 * d] + J_[9 * where + 3 * d + 1] + J_[9 * where + 3 * d + 2]) / 2;
  PetscCallMPI(MPI_Bcast(measures.where, 3, MPIU_REAL, winner.rank, comm));
  PetscCallMPI(MPI_Bcast(&measures.cell, 1, MPIU_INT, winner.rank, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::volume_derivative(Vec x, Vec y, PetscReal &derivative) const
{
  PetscFunctionBeginUser;
  const ReadArray xs(x), ys(y);
  derivative = 0;
  for (PetscInt c = 0; c < cells_; ++c) {
    NodeDisplacements u, v;
    gather_displacements(cell_dofs(c), nodes_, xs.data(), u);
    gather_displacements(cell_dofs(c), nodes_, ys.data(), v);
    PetscReal sum = 0;
    for (std::size_t q = 0; q < sample_weights_.size(); ++q) {
      PetscScalar H[9], G[9], cof_F[9];
      const PetscReal *gradients = &sample_gradients_[q * nodes_ * 3];
      sample_gradient(gradients, &invJ_[9 * c], nodes_, u, H);
      sample_gradient(gradients, &invJ_[9 * c], nodes_, v, G);
      for (int i = 0; i < 3; ++i) H[4 * i] += 1;
      cofactor(H, cof_F);
      sum += sample_weights_[q] * contract(cof_F, G);
    }
    derivative += sum * detJ_[c];
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &derivative, 1, MPIU_REAL, MPI_SUM, PetscObjectComm((PetscObject)dm_)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
