#include "pulmo/fem/integration.hpp"

#include "pulmo/base/attached.hpp"
#include "pulmo/fem/element_products.hpp"

#include <petsc/private/petscfeimpl.h>

#include <optional>
#include <type_traits>

PETSC_EXTERN PetscErrorCode PetscFECreate_Basic(PetscFE);

namespace pulmo {

using namespace element;

namespace {

// ------------------------------------------------------------------------------------------------- callbacks

/// Calls one callback once for all points of a cell, timed if the log asks for it.
class Caller {
public:
  Caller(const PointData &d, PetscReal time, PetscReal time_shift, PetscInt n_constants, const PetscScalar *c,
         IntegrationLog *l)
      : data(d), t(time), shift(time_shift), nc(n_constants), constants(c), log(l)
  {}

  // out: [point][stride]
  void operator()(PetscPointFunc f, PetscScalar *out, PetscInt stride) const
  {
    const Clock clock(*this, reinterpret_cast<void (*)(void)>(f));
    const PointBatch batch = points(stride);
    f(dim, fields().n, all_points, fields().uOff, fields().uOff_x, data.u, data.u_t, data.u_x, nullptr, fields().uOff_x,
      scalars(batch), nullptr, data.rate_x, t, data.x, nc, constants, out);
  }
  void operator()(PetscPointJac g, PetscScalar *out, PetscInt stride) const
  {
    const Clock clock(*this, reinterpret_cast<void (*)(void)>(g));
    const PointBatch batch = points(stride);
    g(dim, fields().n, all_points, fields().uOff, fields().uOff_x, data.u, data.u_t, data.u_x, nullptr, fields().uOff_x,
      scalars(batch), nullptr, data.rate_x, t, shift, data.x, nc, constants, out);
  }
  void operator()(PetscBdPointFunc f, PetscScalar *out, PetscInt stride) const
  {
    const Clock clock(*this, reinterpret_cast<void (*)(void)>(f));
    const PointBatch batch = points(stride);
    f(dim, fields().n, all_points, fields().uOff, fields().uOff_x, data.u, data.u_t, data.u_x, nullptr, fields().uOff_x,
      scalars(batch), nullptr, data.rate_x, t, data.x, data.normals, nc, constants, out);
  }
  void operator()(PetscBdPointJac g, PetscScalar *out, PetscInt stride) const
  {
    const Clock clock(*this, reinterpret_cast<void (*)(void)>(g));
    const PointBatch batch = points(stride);
    g(dim, fields().n, all_points, fields().uOff, fields().uOff_x, data.u, data.u_t, data.u_x, nullptr, fields().uOff_x,
      scalars(batch), nullptr, data.rate_x, t, shift, data.x, data.normals, nc, constants, out);
  }

private:
  class Clock {
  public:
    Clock(const Caller &caller, void (*callback)(void)) : log_(caller.log), callback_(callback)
    {
      if (log_ && log_->timing) (void)PetscTime(&start_);
    }
    ~Clock()
    {
      PetscLogDouble end;
      if (!log_ || !log_->timing) return;
      (void)PetscTime(&end);
      log_->seconds[callback_] += end - start_;
    }
    Clock(const Clock &) = delete;
    Clock &operator=(const Clock &) = delete;

  private:
    IntegrationLog *log_;
    void (*callback_)(void);
    PetscLogDouble start_ = 0;
  };

  const TabulatedFields &fields() const { return *data.fields; }
  PointBatch points(PetscInt stride) const
  {
    return {fields().points, fields().total_components, stride, data.states.data(),
            data.memory.empty() ? nullptr : data.memory.data()};
  }
  static const PetscScalar *scalars(const PointBatch &batch) { return reinterpret_cast<const PetscScalar *>(&batch); }

  const PointData &data;
  PetscReal t, shift;
  PetscInt nc;
  const PetscScalar *constants;
  IntegrationLog *log;
};

/// The residual callbacks of one field; F is PetscPointFunc or PetscBdPointFunc.
template <class F>
struct ResidualCallbacks {
  PetscInt n0 = 0, n1 = 0;
  F *f0 = nullptr, *f1 = nullptr;

  PetscErrorCode find(PetscWeakForm wf, const PetscFormKey &key, PetscInt field)
  {
    PetscFunctionBeginUser;
    if constexpr (std::is_same_v<F, PetscPointFunc>)
      PetscCall(PetscWeakFormGetResidual(wf, key.label, key.value, field, key.part, &n0, &f0, &n1, &f1));
    else
      PetscCall(PetscWeakFormGetBdResidual(wf, key.label, key.value, field, key.part, &n0, &f0, &n1, &f1));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscInt count() const { return n0 + n1; }
};

/// The Jacobian callbacks of one pair of fields; G is PetscPointJac or PetscBdPointJac.
template <class G>
struct JacobianCallbacks {
  PetscInt n0 = 0, n1 = 0, n2 = 0, n3 = 0;
  G *g0 = nullptr, *g1 = nullptr, *g2 = nullptr, *g3 = nullptr;

  PetscErrorCode find(PetscWeakForm wf, const PetscFormKey &k, PetscInt test, PetscInt trial)
  {
    PetscFunctionBeginUser;
    if constexpr (std::is_same_v<G, PetscPointJac>)
      PetscCall(
          PetscWeakFormGetJacobian(wf, k.label, k.value, test, trial, k.part, &n0, &g0, &n1, &g1, &n2, &g2, &n3, &g3));
    else
      PetscCall(PetscWeakFormGetBdJacobian(wf, k.label, k.value, test, trial, k.part, &n0, &g0, &n1, &g1, &n2, &g2, &n3,
                                           &g3));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscInt count() const { return n0 + n1 + n2 + n3; }
};

// -------------------------------------------------------------------------------------------- cells and facets

/// The cells or facets of one call: their tabulations, rule, constants and geometry.
class Places {
public:
  Places(PetscDS ds, const PetscFEGeom *geom, bool facets) : ds_(ds), geom_(geom), facets_(facets) {}

  PetscErrorCode setup()
  {
    PetscFE fe;
    PetscQuadrature rule;
    PetscTabulation *T;
    PetscInt n_fields;

    PetscFunctionBeginUser;
    PetscCheck(geom_->isAffine && geom_->dimEmbed == dim, PETSC_COMM_SELF, PETSC_ERR_SUP,
               "PetscFE type pulmo integrates over straight-sided tetrahedra only");
    PetscCall(PetscDSGetNumFields(ds_, &n_fields));
    PetscCall(PetscDSGetDiscretization(ds_, 0, (PetscObject *)&fe));
    PetscCall(facets_ ? PetscFEGetFaceQuadrature(fe, &rule) : PetscFEGetQuadrature(fe, &rule));
    PetscCall(PetscQuadratureGetData(rule, nullptr, nullptr, nullptr, &reference_, &weights_));
    PetscCall(facets_ ? PetscDSGetFaceTabulation(ds_, &T) : PetscDSGetTabulation(ds_, &T));
    PetscCall(PetscDSGetConstants(ds_, &n_constants, &constants));
    PetscCall(PlaceData::find(ds_, &places_data_));
    if (places_data_ && !places_data_->offsets.empty()) {
      local_constants_.assign(constants, constants + n_constants);
      constants = local_constants_.data();
    }
    PetscCall(IntegrationLog::find(ds_, &log));
    const PetscInt replicas = facets_ ? 4 : 1; // the faces of the reference cell
    tables_.emplace(replicas * fields_scratch(n_fields, T, 1));
    for (PetscInt i = 0; i < replicas; ++i) PetscCall(make_fields(ds_, T, i, *tables_, fields_[i]));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  const TabulatedFields &fields() const { return fields_[0]; }

  /// Makes room for what is remembered at the points, if anything is.
  void remember(PointData &data) const
  {
    if (places_data_ && places_data_->memory.last) data.memory.resize(static_cast<std::size_t>(fields().points));
  }
  /// Fills @p data, and the constants that differ, for place @p e.
  void visit(PetscInt e, const PetscScalar *coefficients, const PetscScalar *coefficients_t, PointData &data)
  {
    if (places_data_) {
      const std::size_t n = places_data_->offsets.size();
      const PetscInt width = places_data_->memory_width, begin = e * fields().points * width;
      if (places_data_->memory.last)
        for (PetscInt q = 0; q < fields().points; ++q) {
          const Memory &first = places_data_->memory;
          data.memory[q] = {first.last + begin + q * width,
                            first.earlier ? first.earlier + begin + q * width : nullptr};
        }
      for (std::size_t k = 0; k < n; ++k)
        local_constants_[static_cast<std::size_t>(places_data_->offsets[k])] =
            places_data_->rows[static_cast<std::size_t>(e) * n + k];
    }
    const PetscInt stride = geom_->numPoints, size = fields().element_size, manifold = facets_ ? dim - 1 : dim;
    const PetscReal *inverse = (facets_ ? geom_->suppInvJ[0] : geom_->invJ) + e * stride * dim * dim;
    const PetscReal *v = geom_->v + e * stride * dim, *J = geom_->J + e * stride * dim * dim;
    static const PetscReal corner[3] = {-1, -1, -1};
    const PetscReal *origin = geom_->xi ? geom_->xi : corner;

    data.fields = &fields_[facets_ ? geom_->face[e][0] : 0];
    data.evaluate(inverse, coefficients + e * size, coefficients_t ? coefficients_t + e * size : nullptr);
    const PetscInt n_points = data.fields->points;
    for (PetscInt q = 0; q < n_points; ++q) {
      const PetscReal *at = reference_ + q * manifold;
      const PetscReal r[dim] = {at[0] - origin[0], at[1] - origin[1], facets_ ? 0 : at[2] - origin[2]};
      data.weights[q] = weights_[q] * geom_->detJ[e * stride];
      for (PetscInt i = 0; i < dim; ++i)
        data.x[q * dim + i] = v[i] + J[i * dim] * r[0] + J[i * dim + 1] * r[1] + J[i * dim + 2] * r[2];
    }
    if (facets_)
      for (PetscInt q = 0; q < n_points; ++q) std::copy_n(geom_->n + e * stride * dim, dim, data.normals + q * dim);
  }

  PetscInt n_constants = 0;
  const PetscScalar *constants = nullptr;
  IntegrationLog *log = nullptr;

private:
  PetscDS ds_;
  const PetscFEGeom *geom_;
  bool facets_;
  const PetscReal *reference_ = nullptr, *weights_ = nullptr;
  std::optional<Scratch> tables_;
  TabulatedFields fields_[4];
  PlaceData *places_data_ = nullptr;
  std::vector<PetscScalar> local_constants_;
};

/// Residual of fields @p first ... @p last - 1 at all places; F is PetscPointFunc or PetscBdPointFunc.
template <class F>
PetscErrorCode integrate_vectors(PetscDS ds, PetscWeakForm wf, const PetscFormKey &key, PetscInt first, PetscInt last,
                                 PetscInt Ne, const PetscFEGeom *geom, const PetscScalar coefficients[],
                                 const PetscScalar coefficients_t[], PetscReal t, PetscScalar vectors[],
                                 PetscInt *n_calls)
{
  ResidualCallbacks<F> callbacks[max_fields];
  Places places(ds, geom, std::is_same_v<F, PetscBdPointFunc>);

  PetscFunctionBeginUser;
  *n_calls = 0;
  for (PetscInt f = first; f < last; ++f) {
    PetscCall(callbacks[f].find(wf, key, f));
    *n_calls += callbacks[f].count();
  }
  if (*n_calls == 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(places.setup());
  const TabulatedFields &fields = places.fields();
  const PetscInt Nq = fields.points;
  Scratch work(PointData::scratch_size(fields) + 2 * Scratch::padded(Nq * 9));
  PointData data(fields, work, false);
  places.remember(data);
  PetscScalar *f0 = work.take(Nq * 3), *f1 = work.take(Nq * 9);
  const Caller call(data, t, 0, places.n_constants, places.constants, places.log);

  *n_calls *= Nq * Ne;
  for (PetscInt e = 0; e < Ne; ++e) {
    places.visit(e, coefficients, coefficients_t, data);
    for (PetscInt f = first; f < last; ++f) {
      const auto &c = callbacks[f];
      const PetscInt C = fields.basis[f].components;
      if (c.count() == 0) continue;
      PetscCall(PetscArrayzero(f0, Nq * C));
      PetscCall(PetscArrayzero(f1, Nq * C * dim));
      for (PetscInt i = 0; i < c.n0; ++i) call(c.f0[i], f0, C);
      for (PetscInt i = 0; i < c.n1; ++i) call(c.f1[i], f1, C * dim);
      add_to_vector(data, f, c.n0 ? f0 : nullptr, c.n1 ? f1 : nullptr, vectors + e * fields.element_size);
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Jacobian blocks of field pairs @p first ... @p last - 1 (pair = test * fields + trial) at all places;
/// G is PetscPointJac or PetscBdPointJac.
template <class G>
PetscErrorCode integrate_matrices(PetscDS ds, PetscWeakForm wf, const PetscFormKey &key, PetscInt first, PetscInt last,
                                  PetscInt Ne, const PetscFEGeom *geom, const PetscScalar coefficients[],
                                  const PetscScalar coefficients_t[], PetscReal t, PetscReal shift,
                                  PetscScalar matrices[], PetscInt *n_calls)
{
  JacobianCallbacks<G> callbacks[max_fields * max_fields];
  Places places(ds, geom, std::is_same_v<G, PetscBdPointJac>);
  PetscInt Nf;

  PetscFunctionBeginUser;
  *n_calls = 0;
  PetscCall(PetscDSGetNumFields(ds, &Nf));
  PetscCheck(Nf <= max_fields, PETSC_COMM_SELF, PETSC_ERR_SUP, "more than %d fields", (int)max_fields);
  for (PetscInt pair = first; pair < last; ++pair) {
    PetscCall(callbacks[pair].find(wf, key, pair / Nf, pair % Nf));
    *n_calls += callbacks[pair].count();
  }
  if (*n_calls == 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(places.setup());
  const TabulatedFields &fields = places.fields();
  const PetscInt Nq = fields.points;
  Scratch work(PointData::scratch_size(fields) + MatrixBuilder::scratch_size(fields) + 4 * Scratch::padded(Nq * 81));
  PointData data(fields, work, true);
  places.remember(data);
  const MatrixBuilder builder(data, work);
  PetscScalar *g0 = work.take(Nq * 9), *g1 = work.take(Nq * 27), *g2 = work.take(Nq * 27), *g3 = work.take(Nq * 81);
  const Caller call(data, t, shift, places.n_constants, places.constants, places.log);

  *n_calls *= Nq * Ne;
  for (PetscInt e = 0; e < Ne; ++e) {
    places.visit(e, coefficients, coefficients_t, data);
    for (PetscInt pair = first; pair < last; ++pair) {
      const auto &c = callbacks[pair];
      const PetscInt test = pair / Nf, trial = pair % Nf;
      const PetscInt entries = fields.basis[test].components * fields.basis[trial].components;
      if (c.count() == 0) continue;
      if (c.n0) PetscCall(PetscArrayzero(g0, Nq * entries));
      if (c.n1) PetscCall(PetscArrayzero(g1, Nq * entries * dim));
      if (c.n2) PetscCall(PetscArrayzero(g2, Nq * entries * dim));
      if (c.n3) PetscCall(PetscArrayzero(g3, Nq * entries * dim * dim));
      for (PetscInt i = 0; i < c.n0; ++i) call(c.g0[i], g0, entries);
      for (PetscInt i = 0; i < c.n1; ++i) call(c.g1[i], g1, entries * dim);
      for (PetscInt i = 0; i < c.n2; ++i) call(c.g2[i], g2, entries * dim);
      for (PetscInt i = 0; i < c.n3; ++i) call(c.g3[i], g3, entries * dim * dim);
      builder.add(test, trial, c.n0 ? g0 : nullptr, c.n1 ? g1 : nullptr, c.n2 ? g2 : nullptr, c.n3 ? g3 : nullptr,
                  matrices + e * fields.element_size * fields.element_size);
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

// -------------------------------------------------------------------------------------------- the PetscFE type

PetscErrorCode integrate_residual(PetscDS ds, PetscFormKey key, PetscInt Ne, PetscFEGeom *geom, const PetscScalar u[],
                                  const PetscScalar u_t[], PetscDS, const PetscScalar[], PetscReal t,
                                  PetscScalar vectors[])
{
  PetscWeakForm wf;
  PetscInt Nf, n_calls;
  IntegrationLog *log;

  PetscFunctionBeginUser;
  if (key.field != 0 || Ne == 0) PetscFunctionReturn(PETSC_SUCCESS); // all fields are done with the first
  PetscCall(PetscDSGetNumFields(ds, &Nf));
  PetscCall(PetscDSGetWeakForm(ds, &wf));
  PetscCall(integrate_vectors<PetscPointFunc>(ds, wf, key, 0, Nf, Ne, geom, u, u_t, t, vectors, &n_calls));
  PetscCall(IntegrationLog::find(ds, &log));
  if (log) {
    log->residual_calls += n_calls;
    log->residual_cells += Ne;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode integrate_jacobian(PetscDS ds, PetscFEJacobianType type, PetscFormKey key, PetscInt Ne,
                                  PetscFEGeom *geom, const PetscScalar u[], const PetscScalar u_t[], PetscDS,
                                  const PetscScalar[], PetscReal t, PetscReal shift, PetscScalar matrices[])
{
  PetscWeakForm wf;
  PetscInt Nf, n_calls;
  IntegrationLog *log;

  PetscFunctionBeginUser;
  if (key.field != 0 || Ne == 0 || type == PETSCFE_JACOBIAN_DYN) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscDSGetNumFields(ds, &Nf));
  PetscCall(PetscDSGetWeakForm(ds, &wf));
  PetscCall(integrate_matrices<PetscPointJac>(ds, wf, key, 0, Nf * Nf, Ne, geom, u, u_t, t, shift, matrices, &n_calls));
  PetscCall(IntegrationLog::find(ds, &log));
  if (log) {
    log->jacobian_calls += n_calls;
    log->jacobian_cells += Ne;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode integrate_surface_residual(PetscDS ds, PetscWeakForm wf, PetscFormKey key, PetscInt Ne,
                                          PetscFEGeom *geom, const PetscScalar u[], const PetscScalar u_t[], PetscDS,
                                          const PetscScalar[], PetscReal t, PetscScalar vectors[])
{
  PetscInt n_calls;

  PetscFunctionBeginUser;
  PetscCall(integrate_vectors<PetscBdPointFunc>(ds, wf, key, key.field, key.field + 1, Ne, geom, u, u_t, t, vectors,
                                                &n_calls));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode integrate_surface_jacobian(PetscDS ds, PetscWeakForm wf, PetscFormKey key, PetscInt Ne,
                                          PetscFEGeom *geom, const PetscScalar u[], const PetscScalar u_t[], PetscDS,
                                          const PetscScalar[], PetscReal t, PetscReal shift, PetscScalar matrices[])
{
  PetscInt n_calls;

  PetscFunctionBeginUser;
  PetscCall(integrate_matrices<PetscBdPointJac>(ds, wf, key, key.field, key.field + 1, Ne, geom, u, u_t, t, shift,
                                                matrices, &n_calls));
  PetscFunctionReturn(PETSC_SUCCESS);
}

// The same with the arguments of newer releases of PETSc: assigning to fe->ops takes the overload that fits.
[[maybe_unused]] PetscErrorCode integrate_jacobian(PetscDS ds, PetscDS, PetscFEJacobianType type, PetscFormKey key,
                                                   PetscInt Ne, PetscFEGeom *geom, const PetscScalar u[],
                                                   const PetscScalar u_t[], PetscDS aux, const PetscScalar a[],
                                                   PetscReal t, PetscReal shift, PetscScalar matrices[])
{
  return integrate_jacobian(ds, type, key, Ne, geom, u, u_t, aux, a, t, shift, matrices);
}

[[maybe_unused]] PetscErrorCode integrate_surface_jacobian(PetscDS ds, PetscWeakForm wf, PetscFEJacobianType,
                                                           PetscFormKey key, PetscInt Ne, PetscFEGeom *geom,
                                                           const PetscScalar u[], const PetscScalar u_t[], PetscDS aux,
                                                           const PetscScalar a[], PetscReal t, PetscReal shift,
                                                           PetscScalar matrices[])
{
  return integrate_surface_jacobian(ds, wf, key, Ne, geom, u, u_t, aux, a, t, shift, matrices);
}

PetscErrorCode create_fe(PetscFE fe)
{
  PetscFunctionBeginUser;
  PetscCall(PetscFECreate_Basic(fe));
  fe->ops->integrateresidual = integrate_residual;
  fe->ops->integratejacobian = integrate_jacobian;
  fe->ops->integratebdresidual = integrate_surface_residual;
  fe->ops->integratebdjacobian = integrate_surface_jacobian;
  PetscFunctionReturn(PETSC_SUCCESS);
}

constexpr const char *log_name = "pulmo_integration_log", *places_name = "pulmo_places";

} // namespace

PetscErrorCode IntegrationLog::attach(PetscDS ds, IntegrationLog *log)
{
  return attach_pointer((PetscObject)ds, log_name, log);
}

PetscErrorCode IntegrationLog::find(PetscDS ds, IntegrationLog **log)
{
  return find_attached((PetscObject)ds, log_name, log);
}

PetscErrorCode PlaceData::attach(PetscDS ds, PlaceData *places)
{
  return attach_pointer((PetscObject)ds, places_name, places);
}

PetscErrorCode PlaceData::find(PetscDS ds, PlaceData **places)
{
  return find_attached((PetscObject)ds, places_name, places);
}

PetscErrorCode register_fe_type()
{
  PetscFunctionBeginUser;
  PetscCall(PetscFERegister("pulmo", create_fe));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
