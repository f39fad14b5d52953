#include "pulmo/observers/error_indicator.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/fem/point_memory.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// Share of a monomial (of its square, summed over the samples) that the others must leave unexplained.
constexpr PetscReal least_pivot = 1e-4;

/// Replaces a symmetric matrix of unit diagonal by its inverse; false if it is near singular.
bool invert(int n, PetscScalar *A)
{
  for (int k = 0; k < n; ++k) { // Gauss-Jordan: the pivot is what the monomials before leave of this one
    const PetscScalar pivot = A[n * k + k];
    if (!(pivot > least_pivot)) return false;
    A[n * k + k] = 1;
    for (int j = 0; j < n; ++j) A[n * k + j] /= pivot;
    for (int i = 0; i < n; ++i) {
      if (i == k) continue;
      const PetscScalar factor = A[n * i + k];
      A[n * i + k] = 0;
      for (int j = 0; j < n; ++j) A[n * i + j] -= factor * A[n * k + j];
    }
  }
  return true;
}

/// Barycentric coordinates of a point of a cell.
std::array<PetscReal, 4> barycentric(const Sampling::Element &e, const PetscReal x[3])
{
  std::array<PetscReal, 4> lambda{1, 0, 0, 0};
  for (int k = 0; k < 3; ++k) {
    for (int d = 0; d < 3; ++d) lambda[k + 1] += e.inverse[3 * k + d] * (x[d] - e.v0[d]) / 2;
    lambda[0] -= lambda[k + 1];
  }
  return lambda;
}

} // namespace

PetscErrorCode Recovery::setup(DM dm, const Sampling &sampling, Samples samples)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscInt vertex_end, cell_begin;
  DM coordinate_dm;
  Vec coordinates;
  PetscSection coordinate_section;

  PetscFunctionBeginUser;
  dm_ = dm;
  if (samples == Samples::centroid) {
    degree_ = 1;
    points_ = {{0.25, 0.25, 0.25, 0.25}};
  } else { // where the error of a gradient of P2 is least: the points of the rule of degree 2
    degree_ = 2;
    const PetscReal b = (5 - std::sqrt(5.)) / 20, a = 1 - 3 * b;
    points_ = {{a, b, b, b}, {b, a, b, b}, {b, b, a, b}, {b, b, b, a}};
  }
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin_, &vertex_end));
  PetscCall(DMPlexGetHeightStratum(dm, 0, &cell_begin, nullptr));
  PetscCall(DMGetCoordinateDM(dm, &coordinate_dm));
  PetscCall(DMGetCoordinatesLocal(dm, &coordinates));
  PetscCall(DMGetLocalSection(coordinate_dm, &coordinate_section));
  n_vertices_ = vertex_end - vertex_begin_;
  PetscReal size[2] = {0, static_cast<PetscReal>(sampling.cells().size())};
  {
    const ReadArray x(coordinates);
    for (const Sampling::Element &e : sampling.cells()) {
      Cell cell{};
      PetscInt n, *closure = nullptr;
      PetscCall(DMPlexGetTransitiveClosure(dm, cell_begin + e.cell, PETSC_TRUE, &n, &closure));
      for (PetscInt i = 0; i < n; ++i) {
        const PetscInt p = closure[2 * i];
        PetscInt offset;
        if (p < vertex_begin_ || p >= vertex_end) continue;
        PetscCall(PetscSectionGetOffset(coordinate_section, p, &offset));
        const auto lambda = barycentric(e, x.data() + offset);
        const auto k = std::max_element(lambda.begin(), lambda.end()) - lambda.begin();
        cell.vertices[k] = p - vertex_begin_;
        std::copy_n(x.data() + offset, 3, cell.x[k].begin());
      }
      PetscCall(DMPlexRestoreTransitiveClosure(dm, cell_begin + e.cell, PETSC_TRUE, &n, &closure));
      cell.volume = e.measure;
      size[0] += e.measure;
      cells_.push_back(cell);
    }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, size, 2, MPIU_REAL, MPIU_SUM, comm));
  length_ = std::cbrt(size[0] / size[1]);

  const PetscInt n = n_monomials[degree_], square = n * n;
  inverses_.assign(n_vertices_ * square, 0);
  for (const Cell &cell : cells_)
    for (int k = 0; k < 4; ++k) {
      PetscScalar *M = &inverses_[cell.vertices[k] * square];
      for (const auto &lambda : points_) {
        PetscReal m[most_monomials];
        monomials(cell, k, lambda.data(), m);
        for (PetscInt i = 0; i < square; ++i) M[i] += cell.volume * m[i / n] * m[i % n];
      }
    }
  PetscCall(sum_over_ranks(square, inverses_));
  degrees_.resize(n_vertices_);
  for (PetscInt v = 0; v < n_vertices_; ++v) degrees_[v] = invert_moments(&inverses_[v * square]);
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Recovery::monomials(const Cell &cell, int k, const PetscReal lambda[4], PetscReal m[most_monomials]) const
{
  PetscReal y[3];
  for (int d = 0; d < 3; ++d) {
    y[d] = -cell.x[k][d];
    for (int j = 0; j < 4; ++j) y[d] += lambda[j] * cell.x[j][d];
    y[d] /= length_;
  }
  m[0] = 1;
  for (int i = 0, n = 4; i < 3; ++i) {
    m[1 + i] = y[i];
    for (int j = i; j < 3; ++j) m[n++] = y[i] * y[j];
  }
}

/// Replaces the moments by the inverse of those of the largest degree that they determine, the rest by 0.
int Recovery::invert_moments(PetscScalar *moments) const
{
  const int row = n_monomials[degree_];
  const std::vector<PetscScalar> M(moments, moments + row * row);

  std::fill_n(moments, row * row, 0.);
  for (int degree = degree_; degree > 0; --degree) {
    const int n = n_monomials[degree];
    PetscScalar A[most_monomials * most_monomials], s[most_monomials];
    for (int i = 0; i < n; ++i) s[i] = 1 / std::sqrt(M[i * row + i]);
    for (int i = 0; i < n * n; ++i) A[i] = M[(i / n) * row + i % n] * s[i / n] * s[i % n];
    if (!invert(n, A)) continue;
    for (int i = 0; i < n * n; ++i) moments[(i / n) * row + i % n] = A[i] * s[i / n] * s[i % n];
    return degree;
  }
  moments[0] = 1 / M[0];
  return 0;
}

PetscErrorCode Recovery::sum_over_ranks(PetscInt per_vertex, std::vector<PetscScalar> &values) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  PetscMPIInt ranks;
  PetscInt begin, end;
  DMHandle vertices;
  SectionHandle section;
  VecHandle local, global;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_size(comm, &ranks));
  if (ranks == 1) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(DMClone(dm_, vertices.out()));
  PetscCall(DMPlexGetChart(dm_, &begin, &end));
  PetscCall(PetscSectionCreate(comm, section.out()));
  PetscCall(PetscSectionSetChart(section, begin, end));
  for (PetscInt v = 0; v < n_vertices_; ++v) PetscCall(PetscSectionSetDof(section, vertex_begin_ + v, per_vertex));
  PetscCall(PetscSectionSetUp(section));
  PetscCall(DMSetLocalSection(vertices, section));
  PetscCall(DMCreateGlobalVector(vertices, global.out()));
  PetscCall(VecCreateSeqWithArray(PETSC_COMM_SELF, 1, (PetscInt)values.size(), values.data(), local.out()));
  PetscCall(DMLocalToGlobal(vertices, local, ADD_VALUES, global));
  PetscCall(DMGlobalToLocal(vertices, global, INSERT_VALUES, local));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Recovery::fit(const std::vector<PetscScalar> &values, PetscInt components)
{
  const PetscInt n = n_monomials[degree_], per_vertex = n * components;
  std::vector<PetscScalar> sums(n_vertices_ * per_vertex, 0);

  PetscFunctionBeginUser;
  components_ = components;
  const PetscScalar *value = values.data();
  for (const Cell &cell : cells_)
    for (const auto &lambda : points_) {
      for (int k = 0; k < 4; ++k) {
        PetscReal m[most_monomials];
        PetscScalar *b = &sums[cell.vertices[k] * per_vertex];
        monomials(cell, k, lambda.data(), m);
        for (PetscInt i = 0; i < per_vertex; ++i) b[i] += cell.volume * value[i / n] * m[i % n];
      }
      value += components;
    }
  PetscCall(sum_over_ranks(per_vertex, sums));
  coefficients_.assign(sums.size(), 0);
  for (PetscInt v = 0; v < n_vertices_; ++v)
    for (PetscInt i = 0; i < per_vertex; ++i)
      for (PetscInt j = 0; j < n; ++j)
        coefficients_[v * per_vertex + i] +=
            inverses_[(v * n + i % n) * n + j] * sums[v * per_vertex + (i / n) * n + j];
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Recovery::evaluate(std::size_t c, const PetscReal lambda[4], PetscScalar value[]) const
{
  const Cell &cell = cells_[c];
  const PetscInt n = n_monomials[degree_];
  int best = 0;
  PetscReal total = 0;

  for (PetscInt v : cell.vertices) best = std::max(best, degrees_[v]);
  std::fill_n(value, components_, 0.);
  for (int k = 0; k < 4; ++k) {
    PetscReal m[most_monomials];
    if (degrees_[cell.vertices[k]] < best) continue; // a corner of the lung with few cells adds nothing
    monomials(cell, k, lambda, m);
    total += lambda[k];
    for (PetscInt i = 0; i < components_; ++i) {
      const PetscScalar *a = &coefficients_[(cell.vertices[k] * components_ + i) * n];
      for (PetscInt j = 0; j < n; ++j) value[i] += lambda[k] * a[j] * m[j];
    }
  }
  for (PetscInt i = 0; i < components_; ++i) value[i] /= total;
}

PetscErrorCode ErrorIndicator::setup()
{
  PetscFunctionBeginUser;
  PetscCall(sampling_.setup(model_));
  PetscCall(stress_.setup(model_.dm(), sampling_, Recovery::Samples::four));
  if (scene_.facts().airflow) PetscCall(gradient_.setup(model_.dm(), sampling_, Recovery::Samples::centroid));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorIndicator::estimate(Vec local, CellErrors &errors)
{
  const bool gas = scene_.facts().airflow;
  const TissueLaw &law = scene_.tissue().law();
  const auto &cells = sampling_.cells();
  std::vector<PointSample> samples;
  std::vector<PetscScalar> stresses, gradients;
  const Step second; // the densities of a step of 1 s are powers

  PetscFunctionBeginUser;
  const ReadArray x(local);
  const PointMemory::Room *room = model_.memory() ? model_.memory()->room() : nullptr;
  const auto accepted = [room](PetscInt cell, std::size_t q) {
    return room ? room->accepted(cell, static_cast<PetscInt>(q)) : Memory();
  };
  for (const Sampling::Element &e : cells) {
    const PetscScalar *constants = model_.constants_at(e.cell);
    const auto &weights = sampling_.weights(e);
    PetscScalar mean[9] = {0}, moments[4][9] = {{0}}, mean_gradient[3] = {0};
    sampling_.sample(e, x.data(), samples);
    for (std::size_t q = 0; q < weights.size(); ++q) {
      const auto lambda = barycentric(e, samples[q].x);
      PetscScalar P[9];
      law.stress(samples[q].state, constants, accepted(e.cell, q), P);
      for (int i = 0; i < 9; ++i) {
        mean[i] += weights[q] * P[i];
        for (int k = 0; k < 4; ++k) moments[k][i] += weights[q] * lambda[k] * P[i];
      }
      for (int d = 0; d < 3; ++d) mean_gradient[d] += weights[q] * samples[q].grad_p[d];
    }
    // the linear field with these moments, at Samples::four
    for (int k = 0; k < 4; ++k)
      for (int i = 0; i < 9; ++i) stresses.push_back(mean[i] + std::sqrt(5.) * (4 * moments[k][i] - mean[i]));
    gradients.insert(gradients.end(), mean_gradient, mean_gradient + 3);
  }
  PetscCall(stress_.fit(stresses, 9));
  if (gas) PetscCall(gradient_.fit(gradients, 3));

  PetscReal whole[2] = {0, 0};
  errors.tissue.assign(cells.size(), 0);
  errors.flow.assign(gas ? cells.size() : 0, 0);
  for (std::size_t c = 0; c < cells.size(); ++c) {
    const Sampling::Element &e = cells[c];
    const PetscScalar *constants = model_.constants_at(e.cell);
    const auto &weights = sampling_.weights(e);
    sampling_.sample(e, x.data(), samples);
    for (std::size_t q = 0; q < weights.size(); ++q) {
      PointSample &s = samples[q];
      const auto lambda = barycentric(e, s.x);
      const PetscReal w = weights[q] * e.measure * units::j_per_kPa_mm3, w_stress = w / (2 * model_.modulus());
      PetscScalar P[9], error[9];
      law.stress(s.state, constants, accepted(e.cell, q), P);
      stress_.evaluate(c, lambda.data(), error);
      for (int i = 0; i < 9; ++i) error[i] -= P[i];
      whole[0] += w_stress * contract(P, P);
      errors.tissue[c] += w_stress * contract(error, error);
      if (!gas) continue;
      const auto dissipation = [&] {
        const Point point = sampling_.point(s, e, 0, second);
        return w * scene_.airflow().dissipation().function(point, point, constants);
      };
      whole[1] += dissipation();
      gradient_.evaluate(c, lambda.data(), error);
      for (int d = 0; d < 3; ++d) s.grad_p[d] = error[d] - s.grad_p[d];
      errors.flow[c] += dissipation();
    }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, whole, 2, MPIU_REAL, MPIU_SUM, PetscObjectComm((PetscObject)model_.dm())));
  errors.stress = whole[0];
  errors.dissipation = whole[1];
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
