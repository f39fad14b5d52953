#include "pulmo/fem/sampling.hpp"

#include "pulmo/mesh/mesh.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace pulmo {

namespace {

/// Volume of PETSc's reference tetrahedron, whose corners are (-1, -1, -1), (1, -1, -1), ...
constexpr PetscReal reference_volume = 4. / 3;

/// Relative weights of a rule and its points.
PetscErrorCode rule_points(PetscQuadrature rule, std::vector<PetscReal> &xi, std::vector<PetscReal> &weights)
{
  PetscInt dim, n;
  const PetscReal *points, *w;

  PetscFunctionBeginUser;
  PetscCall(PetscQuadratureGetData(rule, &dim, nullptr, &n, &points, &w));
  xi.assign(points, points + dim * n);
  weights.assign(w, w + n);
  const PetscReal total = std::accumulate(w, w + n, PetscReal(0));
  for (PetscReal &weight : weights) weight /= total;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Where point @p xi of the reference cell is, mm.
void take_to_mesh(const Sampling::Element &e, const PetscReal xi[3], PetscReal x[3])
{
  for (int d = 0; d < 3; ++d) {
    x[d] = e.v0[d];
    for (int i = 0; i < 3; ++i) x[d] += e.J[3 * d + i] * (xi[i] + 1);
  }
}

/// Gradients (4 x 3, 1/mm) of the barycentric coordinates of a cell.
void barycentric_gradients(const PetscReal inverse[9], PetscReal g[12])
{
  for (int d = 0; d < 3; ++d) {
    g[d] = 0;
    for (int i = 0; i < 3; ++i) {
      g[3 * (i + 1) + d] = inverse[3 * i + d] / 2;
      g[d] -= g[3 * (i + 1) + d];
    }
  }
}

} // namespace

PetscErrorCode Sampling::setup(const Model &model)
{
  PetscDS ds;
  PetscFE fe;
  PetscQuadrature rule, face_rule;
  PetscDualSpace space;
  DM reference;
  const PetscInt *faces;
  PetscInt begin, end;
  std::vector<PetscReal> xi, eta, weights, face_weights;

  PetscFunctionBeginUser;
  dm_ = model.dm();
  assembly_ = &model.assembly();
  gas_ = model.composition().fields().size() > pressure;
  PetscCall(DMGetDS(dm_, &ds));
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &begin, &end));
  for (PetscInt c = begin; c < end; ++c) {
    Element e{};
    PetscReal det;
    PetscCall(DMPlexComputeCellGeometryAffineFEM(dm_, c, e.v0, e.J, e.inverse, &det));
    e.cell = c - begin;
    e.measure = det * reference_volume;
    cells_.push_back(e);
  }

  PetscCall(PetscDSGetDiscretization(ds, displacement, (PetscObject *)&fe));
  PetscCall(PetscFEGetQuadrature(fe, &rule));
  PetscCall(PetscFEGetFaceQuadrature(fe, &face_rule));
  PetscCall(rule_points(rule, xi, weights));
  PetscCall(add_table(xi, weights));
  PetscCall(rule_points(face_rule, eta, face_weights));
  PetscCall(PetscFEGetDualSpace(fe, &space));
  PetscCall(PetscDualSpaceGetDM(space, &reference));
  PetscCall(DMPlexGetCone(reference, 0, &faces));
  for (int f = 0; f < 4; ++f) { // as PETSc tabulates them
    PetscReal v0[3], R[9], inverse[9], det;
    PetscCall(DMPlexComputeCellGeometryFEM(reference, faces[f], nullptr, v0, R, inverse, &det));
    xi.clear();
    for (std::size_t q = 0; q < face_weights.size(); ++q)
      for (int d = 0; d < 3; ++d)
        xi.push_back(v0[d] + R[3 * d] * (eta[2 * q] + 1) + R[3 * d + 1] * (eta[2 * q + 1] + 1));
    PetscCall(add_table(xi, face_weights));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sampling::add_table(const std::vector<PetscReal> &xi, const std::vector<PetscReal> &weights)
{
  PetscDS ds;
  PetscFE fe;
  Table table;

  PetscFunctionBeginUser;
  table.weights = weights;
  table.xi = xi;
  PetscCall(DMGetDS(dm_, &ds));
  PetscCall(PetscDSGetDiscretization(ds, displacement, (PetscObject *)&fe));
  PetscCall(table.u.setup(fe, xi));
  if (gas_) {
    PetscCall(PetscDSGetDiscretization(ds, pressure, (PetscObject *)&fe));
    PetscCall(table.p.setup(fe, xi));
  }
  tables_.push_back(std::move(table));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sampling::surface(const Mesh &mesh, const std::string &name, std::vector<Element> &facets) const
{
  PetscInt cell_begin;
  std::vector<PetscInt> points;

  PetscFunctionBeginUser;
  facets.clear();
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &cell_begin, nullptr));
  PetscCall(mesh.facets(name, points));
  for (PetscInt point : points) {
    const PetscInt *support, *faces;
    PetscReal area, centre[3], gradients[12], least = PETSC_MAX_REAL;
    PetscCall(DMPlexGetSupport(dm_, point, &support));
    PetscCall(DMPlexComputeCellGeometryFVM(dm_, point, &area, centre, nullptr));
    Element e = cells_[support[0] - cell_begin];
    barycentric_gradients(e.inverse, gradients);
    PetscInt opposite = 0;
    for (int k = 0; k < 4; ++k) { // the facet lies where the coordinate of the opposite corner vanishes
      PetscReal lambda = k == 0 ? 1 : 0;
      for (int d = 0; d < 3; ++d) lambda += gradients[3 * k + d] * (centre[d] - e.v0[d]);
      if (std::abs(lambda) < least) {
        least = std::abs(lambda);
        opposite = k;
      }
    }
    const PetscReal *g = &gradients[3 * opposite], slope = std::hypot(g[0], g[1], g[2]);
    PetscCall(DMPlexGetCone(dm_, support[0], &faces));
    e.table = 1 + static_cast<PetscInt>(std::find(faces, faces + 4, point) - faces);
    e.measure = area;
    for (int d = 0; d < 3; ++d) e.normal[d] = -g[d] / slope;
    facets.push_back(e);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Sampling::sample(const Element &e, const PetscScalar *x, std::vector<PointSample> &samples) const
{
  const Table &t = tables_[e.table];
  const element::ScalarBasis of_u = t.u.basis(), of_p = t.p.basis();
  const PetscInt *dofs = assembly_->cell_dofs(e.cell);
  Vector4 u[max_nodes], p[max_nodes], value, gradient[3];

  for (PetscInt a = 0; a < of_u.nodes; ++a) u[a] = Vector4{x[dofs[3 * a]], x[dofs[3 * a + 1]], x[dofs[3 * a + 2]], 0};
  for (PetscInt a = 0; a < of_p.nodes; ++a) p[a] = Vector4{x[dofs[3 * of_u.nodes + a]], 0, 0, 0};
  samples.resize(t.weights.size());
  for (std::size_t q = 0; q < samples.size(); ++q) {
    const auto point = static_cast<PetscInt>(q);
    PointSample &s = samples[q];
    PetscScalar H[9];
    element::interpolate(of_u, point, e.inverse, u, value, gradient);
    for (int i = 0; i < 3; ++i) {
      s.u[i] = value[i];
      for (int d = 0; d < 3; ++d) H[3 * i + d] = gradient[d][i];
    }
    make_point_state(H, nullptr, s.state);
    element::interpolate(of_p, point, e.inverse, p, value, gradient);
    s.p = value[0];
    s.p_t = 0;
    for (int d = 0; d < 3; ++d) {
      s.grad_p[d] = gradient[d][0];
      s.u_t[d] = s.grad_p_t[d] = 0;
    }
    take_to_mesh(e, &t.xi[3 * q], s.x);
  }
}

void Sampling::add_derivatives(const Element &e, const std::vector<SampleDerivative> &derivatives, PetscScalar *y) const
{
  using D = SampleDerivative;
  const Table &t = tables_[e.table];
  const element::ScalarBasis of_u = t.u.basis(), of_p = t.p.basis();
  const PetscInt *dofs = assembly_->cell_dofs(e.cell);
  // one component: by its value and by its gradient in the mesh, at point q
  const auto add = [&](const element::ScalarBasis &basis, std::size_t q, PetscScalar by_value,
                       const PetscScalar by_gradient[3], const PetscInt *at, PetscInt step) {
    const auto n = static_cast<std::size_t>(basis.stride);
    const PetscScalar *B = basis.values + q * n, *G = basis.derivatives + 3 * q * n;
    PetscScalar by[3]; // in the reference cell
    for (int i = 0; i < 3; ++i)
      by[i] = e.inverse[3 * i] * by_gradient[0] + e.inverse[3 * i + 1] * by_gradient[1] +
              e.inverse[3 * i + 2] * by_gradient[2];
    for (PetscInt a = 0; a < basis.nodes; ++a)
      y[at[step * a]] += B[a] * by_value + G[a] * by[0] + G[n + a] * by[1] + G[2 * n + a] * by[2];
  };

  for (std::size_t q = 0; q < derivatives.size(); ++q) {
    const D &d = derivatives[q];
    for (int i = 0; i < 3; ++i) add(of_u, q, d[D::u + i], &d[3 * i], dofs + i, 3);
    if (gas_) add(of_p, q, d[D::p], &d[D::grad_p], dofs + 3 * of_u.nodes, 1);
  }
}

void Sampling::coordinates(const Element &e, std::vector<PetscReal> &x) const
{
  const Table &t = tables_[e.table];

  x.resize(t.xi.size());
  for (std::size_t q = 0; q < t.weights.size(); ++q) take_to_mesh(e, &t.xi[3 * q], &x[3 * q]);
}

void Sampling::make_rates(const PointSample &before, PetscReal dt, PointSample &now)
{
  for (int i = 0; i < 9; ++i) now.state.H_rate[i] = (now.state.H[i] - before.state.H[i]) / dt;
  for (int d = 0; d < 3; ++d) {
    now.u_t[d] = (now.u[d] - before.u[d]) / dt;
    now.grad_p_t[d] = (now.grad_p[d] - before.grad_p[d]) / dt;
  }
  now.p_t = (now.p - before.p) / dt;
}

void Sampling::take_rates(const PointSample &rate, PointSample &now)
{
  std::copy_n(rate.state.H, 9, now.state.H_rate);
  std::copy_n(rate.u, 3, now.u_t);
  std::copy_n(rate.grad_p, 3, now.grad_p_t);
  now.p_t = rate.p;
}

} // namespace pulmo
