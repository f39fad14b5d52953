#include "pulmo/integration.hpp"

#include "pulmo/point.hpp"

#include <petsc/private/petscfeimpl.h>

#include <cstdlib>
#include <new>

PETSC_EXTERN PetscErrorCode PetscFECreate_Basic(PetscFE);

namespace pulmo {

namespace {

constexpr PetscInt dim = 3;
constexpr PetscInt max_fields = 4;
constexpr PetscInt max_components = 3;

// ------------------------------------------------------------------------------------------------ small arrays

/// Zeroed, 64-byte aligned scratch memory that lives for one block of cells.
class Scratch {
public:
  explicit Scratch(std::size_t n)
      : data_(static_cast<PetscScalar *>(std::aligned_alloc(64, (n * sizeof(PetscScalar) + 127) / 64 * 64))), size_(n)
  {
    if (!data_) throw std::bad_alloc();
    std::memset(data_, 0, n * sizeof(PetscScalar));
  }
  ~Scratch() { std::free(data_); }
  Scratch(const Scratch &) = delete;
  Scratch &operator=(const Scratch &) = delete;
  PetscScalar *take(std::size_t n)
  {
    PetscScalar *p = data_ + used_;
    used_ += (n + 7) / 8 * 8;
    return p;
  }
  static std::size_t padded(std::size_t n) { return (n + 7) / 8 * 8; }

private:
  PetscScalar *data_;
  std::size_t size_, used_ = 0;
};

/// Four doubles that the compiler keeps in one vector register (or two, or four).
typedef double Vector4 __attribute__((vector_size(32), aligned(8), may_alias));

/// K[a][b] += sum_r L[r][a] R[r][b]. Rows of L and R have strides @p lda and @p ldb, rows of K @p ldb.
template <int Rows, int Vectors>
inline void product_tile(PetscInt rank, const double *L, PetscInt lda, const double *R, PetscInt ldb, double *K)
{
  Vector4 sum[Rows][Vectors];
  for (int a = 0; a < Rows; ++a)
    for (int v = 0; v < Vectors; ++v) sum[a][v] = *reinterpret_cast<const Vector4 *>(K + a * ldb + 4 * v);
  for (PetscInt r = 0; r < rank; ++r) {
    for (int a = 0; a < Rows; ++a) {
      const double l = L[r * lda + a];
      for (int v = 0; v < Vectors; ++v) sum[a][v] += l * *reinterpret_cast<const Vector4 *>(R + r * ldb + 4 * v);
    }
  }
  for (int a = 0; a < Rows; ++a)
    for (int v = 0; v < Vectors; ++v) *reinterpret_cast<Vector4 *>(K + a * ldb + 4 * v) = sum[a][v];
}

/// The same for any number of rows; @p ldb is a multiple of 4.
template <int Vectors>
inline void product_rows(PetscInt rows, PetscInt rank, const double *L, PetscInt lda, const double *R, PetscInt ldb,
                         double *K)
{
  PetscInt a = 0;
  for (; a + 5 <= rows; a += 5) product_tile<5, Vectors>(rank, L + a, lda, R, ldb, K + a * ldb);
  for (; a + 2 <= rows; a += 2) product_tile<2, Vectors>(rank, L + a, lda, R, ldb, K + a * ldb);
  for (; a < rows; ++a) product_tile<1, Vectors>(rank, L + a, lda, R, ldb, K + a * ldb);
}

inline void product(PetscInt rows, PetscInt rank, const double *L, PetscInt lda, const double *R, PetscInt ldb, double *K)
{
  PetscInt b = 0;
  for (; b + 12 <= ldb; b += 12) product_rows<3>(rows, rank, L, lda, R + b, ldb, K + b);
  for (; b < ldb; b += 4) product_rows<1>(rows, rank, L, lda, R + b, ldb, K + b);
}

// ------------------------------------------------------------------------------------------------- tabulation

/// One scalar component of a Lagrange basis at the points of a rule, rows padded to a multiple of 4.
struct ScalarBasis {
  PetscInt nodes = 0, components = 0, stride = 0, offset = 0; ///< offset: of the field in the element vector
  const PetscScalar *values = nullptr;                        ///< [point][stride]
  const PetscScalar *derivatives = nullptr;                   ///< [point][dim][stride], in the reference cell
};

/// The fields of a PetscDS at a rule.
struct Fields {
  PetscInt n = 0, points = 0, element_size = 0, total_components = 0;
  PetscInt uOff[max_fields + 1], uOff_x[max_fields + 1]; ///< as PetscDS: where a field's values and gradients begin
  ScalarBasis basis[max_fields];
};

std::size_t fields_scratch(PetscInt n, PetscTabulation *T, PetscInt replicas)
{
  std::size_t size = 0;
  for (PetscInt f = 0; f < n; ++f)
    size += 4 * Scratch::padded(static_cast<std::size_t>(replicas * T[f]->Np * (T[f]->Nb + 4)));
  return size;
}

/// Copies one component of PETSc's tabulation. @p replica: the face of the reference cell, 0 for cells.
PetscErrorCode make_fields(PetscDS ds, PetscTabulation *T, PetscInt replica, Scratch &scratch, Fields &fields)
{
  PetscFunctionBeginUser;
  PetscCall(PetscDSGetNumFields(ds, &fields.n));
  PetscCheck(fields.n <= max_fields, PETSC_COMM_SELF, PETSC_ERR_SUP, "more than %d fields", (int)max_fields);
  fields.points = T[0]->Np;
  fields.uOff[0] = fields.uOff_x[0] = fields.element_size = 0;
  for (PetscInt f = 0; f < fields.n; ++f) {
    ScalarBasis &basis = fields.basis[f];
    const PetscInt Nc = T[f]->Nc, Nb = T[f]->Nb, Np = T[f]->Np;
    PetscCheck(Np == fields.points, PETSC_COMM_SELF, PETSC_ERR_ARG_INCOMP, "fields differ in their quadrature");
    PetscCheck(Nc <= max_components, PETSC_COMM_SELF, PETSC_ERR_SUP, "more than %d components", (int)max_components);
    basis.components = Nc;
    basis.nodes = Nb / Nc;
    basis.stride = (basis.nodes + 3) / 4 * 4;
    basis.offset = fields.element_size;
    PetscScalar *B = scratch.take(Np * basis.stride), *D = scratch.take(Np * dim * basis.stride);
    for (PetscInt q = 0; q < Np; ++q) {
      for (PetscInt a = 0; a < basis.nodes; ++a) {
        const PetscInt row = ((replica * Np + q) * Nb + a * Nc) * Nc; // component 0 of node a
        B[q * basis.stride + a] = T[f]->T[0][row];
        for (PetscInt d = 0; d < dim; ++d) D[(q * dim + d) * basis.stride + a] = T[f]->T[1][row * dim + d];
      }
    }
    basis.values = B;
    basis.derivatives = D;
    fields.element_size += Nb;
    fields.uOff[f + 1] = fields.uOff[f] + Nc;
    fields.uOff_x[f + 1] = fields.uOff_x[f] + Nc * dim;
  }
  fields.total_components = fields.uOff[fields.n];
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Everything that callbacks read at the points of one cell or face.
struct PointData {
  const Fields &fields;
  PetscScalar *gradients[max_fields]; ///< [point][dim][stride], real space
  PetscScalar *u, *u_t, *u_x;         ///< [point][...] with the offsets of Fields
  PetscScalar *weights;               ///< quadrature weight times det J
  PetscReal *x, *normals;             ///< [point][3]
  std::vector<PointState> states;

  PointData(const Fields &f, Scratch &scratch) : fields(f), states(static_cast<std::size_t>(f.points))
  {
    for (PetscInt i = 0; i < f.n; ++i) gradients[i] = scratch.take(f.points * dim * f.basis[i].stride);
    u = scratch.take(f.points * f.total_components);
    u_t = scratch.take(f.points * f.total_components);
    u_x = scratch.take(f.points * f.total_components * dim);
    weights = scratch.take(f.points);
    x = scratch.take(f.points * dim);
    normals = scratch.take(f.points * dim);
  }
  static std::size_t scratch_size(const Fields &f)
  {
    std::size_t size = Scratch::padded(f.points) + 2 * Scratch::padded(f.points * dim);
    for (PetscInt i = 0; i < f.n; ++i) size += Scratch::padded(f.points * dim * f.basis[i].stride);
    return size + 3 * Scratch::padded(f.points * f.total_components * dim);
  }

  /// Gradients in real space, field values, rates and kinematic states from the element's coefficients.
  void evaluate(const PetscReal inverse_J[9], const PetscScalar coefficients[], const PetscScalar coefficients_t[])
  {
    const PetscInt Nc = fields.total_components;
    for (PetscInt f = 0; f < fields.n; ++f) {
      const ScalarBasis &basis = fields.basis[f];
      const PetscInt n = basis.stride;
      for (PetscInt q = 0; q < fields.points; ++q) {
        const PetscScalar *D = basis.derivatives + q * dim * n;
        PetscScalar *G = gradients[f] + q * dim * n;
        for (PetscInt d = 0; d < dim; ++d)
          for (PetscInt a = 0; a < n; ++a)
            G[d * n + a] = inverse_J[d] * D[a] + inverse_J[dim + d] * D[n + a] + inverse_J[2 * dim + d] * D[2 * n + a];
      }
    }
    for (PetscInt q = 0; q < fields.points; ++q) {
      PetscScalar rate_x[9];
      for (PetscInt f = 0; f < fields.n; ++f) {
        const ScalarBasis &basis = fields.basis[f];
        const PetscInt n = basis.stride, C = basis.components;
        const PetscScalar *B = basis.values + q * n, *G = gradients[f] + q * dim * n;
        for (PetscInt c = 0; c < C; ++c) {
          const PetscScalar *e = coefficients + basis.offset + c;
          PetscScalar s = 0, s_t = 0, g[3] = {0, 0, 0}, g_t[3] = {0, 0, 0};
          for (PetscInt a = 0; a < basis.nodes; ++a) {
            s += B[a] * e[a * C];
            for (PetscInt d = 0; d < dim; ++d) g[d] += G[d * n + a] * e[a * C];
          }
          if (coefficients_t) {
            const PetscScalar *e_t = coefficients_t + basis.offset + c;
            for (PetscInt a = 0; a < basis.nodes; ++a) {
              s_t += B[a] * e_t[a * C];
              for (PetscInt d = 0; d < dim; ++d) g_t[d] += G[d * n + a] * e_t[a * C];
            }
          }
          u[q * Nc + fields.uOff[f] + c] = s;
          u_t[q * Nc + fields.uOff[f] + c] = s_t;
          for (PetscInt d = 0; d < dim; ++d) {
            u_x[q * Nc * dim + fields.uOff_x[f] + c * dim + d] = g[d];
            if (f == displacement) rate_x[c * dim + d] = g_t[d];
          }
        }
      }
      make_point_state(u_x + q * Nc * dim + fields.uOff_x[displacement], rate_x, states[q]);
    }
  }
};

// ------------------------------------------------------------------------------------------------- callbacks

/// Calls one callback at all points of a cell, timed if the log asks for it.
class Caller {
public:
  Caller(const PointData &d, PetscReal time, PetscReal time_shift, PetscInt n_constants, const PetscScalar *c,
         IntegrationLog *l)
      : data(d), t(time), shift(time_shift), nc(n_constants), constants(c), log(l)
  {
  }

  // out: [point][stride]
  void operator()(PetscPointFunc f, PetscScalar *out, PetscInt stride) const
  {
    const Clock clock(*this, reinterpret_cast<void (*)(void)>(f));
    for (PetscInt q = 0; q < data.fields.points; ++q)
      f(dim, data.fields.n, precomputed_state, data.fields.uOff, data.fields.uOff_x, u(q), u_t(q), u_x(q), nullptr,
        nullptr, state(q), nullptr, nullptr, t, data.x + q * dim, nc, constants, out + q * stride);
  }
  void operator()(PetscPointJac g, PetscScalar *out, PetscInt stride) const
  {
    const Clock clock(*this, reinterpret_cast<void (*)(void)>(g));
    for (PetscInt q = 0; q < data.fields.points; ++q)
      g(dim, data.fields.n, precomputed_state, data.fields.uOff, data.fields.uOff_x, u(q), u_t(q), u_x(q), nullptr,
        nullptr, state(q), nullptr, nullptr, t, shift, data.x + q * dim, nc, constants, out + q * stride);
  }
  // PetscPointJac and PetscBdPointFunc differ only in meaning of an argument or two, hence the names
  void surface(PetscBdPointFunc f, PetscScalar *out, PetscInt stride) const
  {
    const Clock clock(*this, reinterpret_cast<void (*)(void)>(f));
    for (PetscInt q = 0; q < data.fields.points; ++q)
      f(dim, data.fields.n, precomputed_state, data.fields.uOff, data.fields.uOff_x, u(q), u_t(q), u_x(q), nullptr,
        nullptr, state(q), nullptr, nullptr, t, data.x + q * dim, data.normals + q * dim, nc, constants,
        out + q * stride);
  }
  void surface(PetscBdPointJac g, PetscScalar *out, PetscInt stride) const
  {
    const Clock clock(*this, reinterpret_cast<void (*)(void)>(g));
    for (PetscInt q = 0; q < data.fields.points; ++q)
      g(dim, data.fields.n, precomputed_state, data.fields.uOff, data.fields.uOff_x, u(q), u_t(q), u_x(q), nullptr,
        nullptr, state(q), nullptr, nullptr, t, shift, data.x + q * dim, data.normals + q * dim, nc, constants,
        out + q * stride);
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

  const PetscScalar *u(PetscInt q) const { return data.u + q * data.fields.total_components; }
  const PetscScalar *u_t(PetscInt q) const { return data.u_t + q * data.fields.total_components; }
  const PetscScalar *u_x(PetscInt q) const { return data.u_x + q * data.fields.total_components * dim; }
  const PetscScalar *state(PetscInt q) const { return reinterpret_cast<const PetscScalar *>(&data.states[q]); }

  const PointData &data;
  PetscReal t, shift;
  PetscInt nc;
  const PetscScalar *constants;
  IntegrationLog *log;
};

/// The residual callbacks of one field.
template <class F>
struct ResidualCallbacks {
  PetscInt n0 = 0, n1 = 0;
  F *f0 = nullptr, *f1 = nullptr;
};

/// The Jacobian callbacks of one pair of fields.
template <class G>
struct JacobianCallbacks {
  PetscInt n0 = 0, n1 = 0, n2 = 0, n3 = 0;
  G *g0 = nullptr, *g1 = nullptr, *g2 = nullptr, *g3 = nullptr;
  PetscInt count() const { return n0 + n1 + n2 + n3; }
};

/// vector[node * C + c] += sum_q w (f0_c B + f1_cd G_d).
void add_to_vector(const PointData &data, PetscInt field, const PetscScalar *f0, const PetscScalar *f1,
                   PetscScalar *vector)
{
  const ScalarBasis &basis = data.fields.basis[field];
  const PetscInt C = basis.components, n = basis.stride;
  alignas(64) PetscScalar sum[64];
  for (PetscInt c = 0; c < C; ++c) {
    for (PetscInt a = 0; a < n; ++a) sum[a] = 0;
    for (PetscInt q = 0; q < data.fields.points; ++q) {
      const PetscScalar w = data.weights[q], *B = basis.values + q * n, *G = data.gradients[field] + q * dim * n;
      if (f0) {
        const PetscScalar s = w * f0[q * C + c];
        for (PetscInt a = 0; a < n; ++a) sum[a] += s * B[a];
      }
      if (f1) {
        const PetscScalar *f = f1 + (q * C + c) * dim;
        const PetscScalar s0 = w * f[0], s1 = w * f[1], s2 = w * f[2];
        for (PetscInt a = 0; a < n; ++a) sum[a] += s0 * G[a] + s1 * G[n + a] + s2 * G[2 * n + a];
      }
    }
    for (PetscInt a = 0; a < basis.nodes; ++a) vector[basis.offset + a * C + c] += sum[a];
  }
}

/// The element matrix of one pair of fields from g0 ... g3 at all points (null where a pair has none).
struct MatrixBuilder {
  const PointData &data;
  PetscScalar *left, *right, *block; ///< [rank][stride of test], [rank][stride of trial], [node][stride of trial]

  static constexpr PetscInt rows_per_point = dim + 1;

  static std::size_t scratch_size(const Fields &f)
  {
    std::size_t widest = 0;
    for (PetscInt i = 0; i < f.n; ++i) widest = std::max(widest, Scratch::padded(f.basis[i].stride));
    return (2 * static_cast<std::size_t>(f.points * rows_per_point) + widest + 8) * widest;
  }
  MatrixBuilder(const PointData &d, Scratch &scratch) : data(d)
  {
    std::size_t widest = 0;
    for (PetscInt i = 0; i < d.fields.n; ++i) widest = std::max(widest, Scratch::padded(d.fields.basis[i].stride));
    left = scratch.take(d.fields.points * rows_per_point * widest);
    right = scratch.take(d.fields.points * rows_per_point * widest);
    block = scratch.take(widest * widest);
  }

  void add(PetscInt test, PetscInt trial, const PetscScalar *g0, const PetscScalar *g1, const PetscScalar *g2,
           const PetscScalar *g3, PetscScalar *matrix) const
  {
    const ScalarBasis &bi = data.fields.basis[test], &bj = data.fields.basis[trial];
    const PetscInt Ci = bi.components, Cj = bj.components, ni = bi.stride, nj = bj.stride, Nq = data.fields.points;
    const bool by_gradient = g2 || g3, by_value = g0 || g1; // of the test function
    const PetscInt per_point = dim * by_gradient + by_value, rank = Nq * per_point;

    for (PetscInt q = 0; q < Nq; ++q) {
      PetscScalar *l = left + q * per_point * ni;
      if (by_gradient) {
        const PetscScalar *G = data.gradients[test] + q * dim * ni;
        for (PetscInt i = 0; i < dim * ni; ++i) l[i] = G[i];
        l += dim * ni;
      }
      if (by_value)
        for (PetscInt i = 0; i < ni; ++i) l[i] = bi.values[q * ni + i];
    }
    for (PetscInt c = 0; c < Ci; ++c) {
      for (PetscInt e = 0; e < Cj; ++e) {
        const PetscInt pair = c * Cj + e;
        for (PetscInt q = 0; q < Nq; ++q) {
          const PetscScalar w = data.weights[q], *B = bj.values + q * nj, *G = data.gradients[trial] + q * dim * nj;
          PetscScalar *r = right + q * per_point * nj;
          if (by_gradient) {
            for (PetscInt d = 0; d < dim; ++d, r += nj) {
              const PetscScalar v = g2 ? w * g2[(q * Ci * Cj + pair) * dim + d] : 0;
              if (g3) {
                const PetscScalar *g = g3 + ((q * Ci * Cj + pair) * dim + d) * dim;
                const PetscScalar s0 = w * g[0], s1 = w * g[1], s2 = w * g[2];
                for (PetscInt b = 0; b < nj; ++b) r[b] = s0 * G[b] + s1 * G[nj + b] + s2 * G[2 * nj + b] + v * B[b];
              } else {
                for (PetscInt b = 0; b < nj; ++b) r[b] = v * B[b];
              }
            }
          }
          if (by_value) {
            const PetscScalar v = g0 ? w * g0[q * Ci * Cj + pair] : 0;
            if (g1) {
              const PetscScalar *g = g1 + (q * Ci * Cj + pair) * dim;
              const PetscScalar s0 = w * g[0], s1 = w * g[1], s2 = w * g[2];
              for (PetscInt b = 0; b < nj; ++b) r[b] = s0 * G[b] + s1 * G[nj + b] + s2 * G[2 * nj + b] + v * B[b];
            } else {
              for (PetscInt b = 0; b < nj; ++b) r[b] = v * B[b];
            }
          }
        }
        for (PetscInt i = 0; i < bi.nodes * nj; ++i) block[i] = 0;
        product(bi.nodes, rank, left, ni, right, nj, block);
        for (PetscInt a = 0; a < bi.nodes; ++a) {
          PetscScalar *row = matrix + (bi.offset + a * Ci + c) * data.fields.element_size + bj.offset + e;
          for (PetscInt b = 0; b < bj.nodes; ++b) row[b * Cj] += block[a * nj + b];
        }
      }
    }
  }
};

/// Material coordinates of the points of cell @p e.
void cell_points(const PetscFEGeom *geom, PetscInt e, PetscInt Nq, const PetscReal *reference, PetscReal *x)
{
  const PetscReal *v = geom->v + e * geom->numPoints * dim, *J = geom->J + e * geom->numPoints * dim * dim;
  const PetscReal corner[3] = {-1, -1, -1}, *origin = geom->xi ? geom->xi : corner;
  for (PetscInt q = 0; q < Nq; ++q)
    for (PetscInt i = 0; i < dim; ++i) {
      x[q * dim + i] = v[i];
      for (PetscInt d = 0; d < dim; ++d) x[q * dim + i] += J[i * dim + d] * (reference[q * dim + d] - origin[d]);
    }
}

PetscErrorCode check_geometry(const PetscFEGeom *geom)
{
  PetscFunctionBeginUser;
  PetscCheck(geom->isAffine && geom->dimEmbed == dim, PETSC_COMM_SELF, PETSC_ERR_SUP,
             "PetscFE type pulmo integrates over straight-sided tetrahedra only");
  PetscFunctionReturn(PETSC_SUCCESS);
}

// -------------------------------------------------------------------------------------------- the PetscFE type

PetscErrorCode integrate_residual(PetscDS ds, PetscFormKey key, PetscInt Ne, PetscFEGeom *geom,
                                  const PetscScalar coefficients[], const PetscScalar coefficients_t[], PetscDS,
                                  const PetscScalar[], PetscReal t, PetscScalar vectors[])
{
  PetscTabulation *T;
  PetscQuadrature rule;
  PetscFE fe;
  PetscWeakForm wf;
  PetscInt Nf, Nq, nc, n_calls = 0;
  const PetscReal *reference, *weights;
  const PetscScalar *constants;
  IntegrationLog *log;

  PetscFunctionBeginUser;
  if (key.field != 0 || Ne == 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(check_geometry(geom));
  PetscCall(PetscDSGetNumFields(ds, &Nf));
  PetscCall(PetscDSGetTabulation(ds, &T));
  PetscCall(PetscDSGetDiscretization(ds, 0, (PetscObject *)&fe));
  PetscCall(PetscFEGetQuadrature(fe, &rule));
  PetscCall(PetscQuadratureGetData(rule, nullptr, nullptr, &Nq, &reference, &weights));
  PetscCall(PetscDSGetConstants(ds, &nc, &constants));
  PetscCall(PetscDSGetWeakForm(ds, &wf));
  PetscCall(IntegrationLog::find(ds, &log));

  ResidualCallbacks<PetscPointFunc> callbacks[max_fields];
  for (PetscInt f = 0; f < Nf; ++f) {
    auto &c = callbacks[f];
    PetscCall(PetscWeakFormGetResidual(wf, key.label, key.value, f, key.part, &c.n0, &c.f0, &c.n1, &c.f1));
    n_calls += c.n0 + c.n1;
  }
  Scratch tables(fields_scratch(Nf, T, 1));
  Fields fields;
  PetscCall(make_fields(ds, T, 0, tables, fields));
  Scratch work(PointData::scratch_size(fields) + 2 * Scratch::padded(Nq * 9));
  PointData data(fields, work);
  PetscScalar *f0 = work.take(Nq * 3), *f1 = work.take(Nq * 9);
  const Caller call(data, t, 0, nc, constants, log);

  for (PetscInt e = 0; e < Ne; ++e) {
    const PetscScalar *u_t = coefficients_t ? coefficients_t + e * fields.element_size : nullptr;
    data.evaluate(geom->invJ + e * geom->numPoints * dim * dim, coefficients + e * fields.element_size, u_t);
    cell_points(geom, e, Nq, reference, data.x);
    for (PetscInt q = 0; q < Nq; ++q) data.weights[q] = weights[q] * geom->detJ[e * geom->numPoints];
    for (PetscInt f = 0; f < Nf; ++f) {
      const auto &c = callbacks[f];
      const PetscInt C = fields.basis[f].components;
      if (c.n0 + c.n1 == 0) continue;
      PetscCall(PetscArrayzero(f0, Nq * C));
      PetscCall(PetscArrayzero(f1, Nq * C * dim));
      for (PetscInt i = 0; i < c.n0; ++i) call(c.f0[i], f0, C);
      for (PetscInt i = 0; i < c.n1; ++i) call(c.f1[i], f1, C * dim);
      add_to_vector(data, f, c.n0 ? f0 : nullptr, c.n1 ? f1 : nullptr, vectors + e * fields.element_size);
    }
  }
  if (log) {
    log->residual_calls += n_calls * Ne * Nq;
    log->residual_cells += Ne;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode integrate_jacobian(PetscDS ds, PetscFEJacobianType type, PetscFormKey key, PetscInt Ne,
                                  PetscFEGeom *geom, const PetscScalar coefficients[],
                                  const PetscScalar coefficients_t[], PetscDS, const PetscScalar[], PetscReal t,
                                  PetscReal shift, PetscScalar matrices[])
{
  PetscTabulation *T;
  PetscQuadrature rule;
  PetscFE fe;
  PetscWeakForm wf;
  PetscInt Nf, Nq, nc, n_calls = 0;
  const PetscReal *reference, *weights;
  const PetscScalar *constants;
  IntegrationLog *log;

  PetscFunctionBeginUser;
  if (key.field != 0 || Ne == 0 || type == PETSCFE_JACOBIAN_DYN) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(check_geometry(geom));
  PetscCall(PetscDSGetNumFields(ds, &Nf));
  PetscCall(PetscDSGetTabulation(ds, &T));
  PetscCall(PetscDSGetDiscretization(ds, 0, (PetscObject *)&fe));
  PetscCall(PetscFEGetQuadrature(fe, &rule));
  PetscCall(PetscQuadratureGetData(rule, nullptr, nullptr, &Nq, &reference, &weights));
  PetscCall(PetscDSGetConstants(ds, &nc, &constants));
  PetscCall(PetscDSGetWeakForm(ds, &wf));
  PetscCall(IntegrationLog::find(ds, &log));

  JacobianCallbacks<PetscPointJac> callbacks[max_fields][max_fields];
  for (PetscInt f = 0; f < Nf; ++f)
    for (PetscInt g = 0; g < Nf; ++g) {
      auto &c = callbacks[f][g];
      PetscCall(PetscWeakFormGetJacobian(wf, key.label, key.value, f, g, key.part, &c.n0, &c.g0, &c.n1, &c.g1, &c.n2,
                                         &c.g2, &c.n3, &c.g3));
      n_calls += c.count();
    }
  Scratch tables(fields_scratch(Nf, T, 1));
  Fields fields;
  PetscCall(make_fields(ds, T, 0, tables, fields));
  Scratch work(PointData::scratch_size(fields) + MatrixBuilder::scratch_size(fields) + 4 * Scratch::padded(Nq * 81));
  PointData data(fields, work);
  const MatrixBuilder builder(data, work);
  PetscScalar *g0 = work.take(Nq * 9), *g1 = work.take(Nq * 27), *g2 = work.take(Nq * 27), *g3 = work.take(Nq * 81);
  const Caller call(data, t, shift, nc, constants, log);

  for (PetscInt e = 0; e < Ne; ++e) {
    const PetscScalar *u_t = coefficients_t ? coefficients_t + e * fields.element_size : nullptr;
    data.evaluate(geom->invJ + e * geom->numPoints * dim * dim, coefficients + e * fields.element_size, u_t);
    cell_points(geom, e, Nq, reference, data.x);
    for (PetscInt q = 0; q < Nq; ++q) data.weights[q] = weights[q] * geom->detJ[e * geom->numPoints];
    for (PetscInt f = 0; f < Nf; ++f)
      for (PetscInt g = 0; g < Nf; ++g) {
        const auto &c = callbacks[f][g];
        const PetscInt pairs = fields.basis[f].components * fields.basis[g].components;
        if (c.count() == 0) continue;
        if (c.n0) PetscCall(PetscArrayzero(g0, Nq * pairs));
        if (c.n1) PetscCall(PetscArrayzero(g1, Nq * pairs * dim));
        if (c.n2) PetscCall(PetscArrayzero(g2, Nq * pairs * dim));
        if (c.n3) PetscCall(PetscArrayzero(g3, Nq * pairs * dim * dim));
        for (PetscInt i = 0; i < c.n0; ++i) call(c.g0[i], g0, pairs);
        for (PetscInt i = 0; i < c.n1; ++i) call(c.g1[i], g1, pairs * dim);
        for (PetscInt i = 0; i < c.n2; ++i) call(c.g2[i], g2, pairs * dim);
        for (PetscInt i = 0; i < c.n3; ++i) call(c.g3[i], g3, pairs * dim * dim);
        builder.add(f, g, c.n0 ? g0 : nullptr, c.n1 ? g1 : nullptr, c.n2 ? g2 : nullptr, c.n3 ? g3 : nullptr,
                    matrices + e * fields.element_size * fields.element_size);
      }
  }
  if (log) {
    log->jacobian_calls += n_calls * Ne * Nq;
    log->jacobian_cells += Ne;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// What the points of a face need: weights, normals and coordinates.
void face_points(const PetscFEGeom *geom, PetscInt e, const PetscReal *weights, PointData &data)
{
  for (PetscInt q = 0; q < data.fields.points; ++q) {
    data.weights[q] = weights[q] * geom->detJ[e * geom->numPoints];
    for (PetscInt d = 0; d < dim; ++d) {
      data.normals[q * dim + d] = geom->n[e * geom->numPoints * dim + d];
      data.x[q * dim + d] = 0;
    }
  }
}

/// Material coordinates of the points of face @p e, by the affine map of the face that @p geom holds.
void face_coordinates(const PetscFEGeom *geom, PetscInt e, PetscInt Nq, const PetscReal *reference, PetscReal *x)
{
  const PetscReal *v = geom->v + e * geom->numPoints * dim, *J = geom->J + e * geom->numPoints * dim * dim;
  const PetscReal corner[2] = {-1, -1}, *origin = geom->xi ? geom->xi : corner;
  for (PetscInt q = 0; q < Nq; ++q)
    for (PetscInt i = 0; i < dim; ++i) {
      x[q * dim + i] = v[i];
      for (PetscInt d = 0; d < dim - 1; ++d)
        x[q * dim + i] += J[i * dim + d] * (reference[q * (dim - 1) + d] - origin[d]);
    }
}

PetscErrorCode integrate_surface_residual(PetscDS ds, PetscWeakForm wf, PetscFormKey key, PetscInt Ne,
                                          PetscFEGeom *geom, const PetscScalar coefficients[],
                                          const PetscScalar coefficients_t[], PetscDS, const PetscScalar[],
                                          PetscReal t, PetscScalar vectors[])
{
  PetscTabulation *T;
  PetscQuadrature rule;
  PetscFE fe;
  PetscInt Nf, Nq, nc;
  const PetscReal *reference, *weights;
  const PetscScalar *constants;
  IntegrationLog *log;
  ResidualCallbacks<PetscBdPointFunc> c;

  PetscFunctionBeginUser;
  PetscCall(PetscWeakFormGetBdResidual(wf, key.label, key.value, key.field, key.part, &c.n0, &c.f0, &c.n1, &c.f1));
  if (c.n0 + c.n1 == 0 || Ne == 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(check_geometry(geom));
  PetscCall(PetscDSGetNumFields(ds, &Nf));
  PetscCall(PetscDSGetFaceTabulation(ds, &T));
  PetscCall(PetscDSGetDiscretization(ds, 0, (PetscObject *)&fe));
  PetscCall(PetscFEGetFaceQuadrature(fe, &rule));
  PetscCall(PetscQuadratureGetData(rule, nullptr, nullptr, &Nq, &reference, &weights));
  PetscCall(PetscDSGetConstants(ds, &nc, &constants));
  PetscCall(IntegrationLog::find(ds, &log));

  Scratch tables(4 * fields_scratch(Nf, T, 1));
  Fields faces[4];
  for (PetscInt i = 0; i < 4; ++i) PetscCall(make_fields(ds, T, i, tables, faces[i]));
  const PetscInt size = faces[0].element_size, C = faces[0].basis[key.field].components;
  for (PetscInt e = 0; e < Ne; ++e) {
    Scratch work(PointData::scratch_size(faces[0]) + 2 * Scratch::padded(Nq * 9));
    PointData data(faces[geom->face[e][0]], work);
    PetscScalar *f0 = work.take(Nq * C), *f1 = work.take(Nq * C * dim);
    const Caller call(data, t, 0, nc, constants, log);
    data.evaluate(geom->suppInvJ[0] + e * geom->numPoints * dim * dim, coefficients + e * size,
                  coefficients_t ? coefficients_t + e * size : nullptr);
    face_points(geom, e, weights, data);
    face_coordinates(geom, e, Nq, reference, data.x);
    for (PetscInt i = 0; i < c.n0; ++i) call.surface(c.f0[i], f0, C);
    for (PetscInt i = 0; i < c.n1; ++i) call.surface(c.f1[i], f1, C * dim);
    add_to_vector(data, key.field, c.n0 ? f0 : nullptr, c.n1 ? f1 : nullptr, vectors + e * size);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode integrate_surface_jacobian(PetscDS ds, PetscWeakForm wf, PetscFormKey key, PetscInt Ne,
                                          PetscFEGeom *geom, const PetscScalar coefficients[],
                                          const PetscScalar coefficients_t[], PetscDS, const PetscScalar[],
                                          PetscReal t, PetscReal shift, PetscScalar matrices[])
{
  PetscTabulation *T;
  PetscQuadrature rule;
  PetscFE fe;
  PetscInt Nf, Nq, nc;
  const PetscReal *reference, *weights;
  const PetscScalar *constants;
  IntegrationLog *log;
  JacobianCallbacks<PetscBdPointJac> c;

  PetscFunctionBeginUser;
  PetscCall(PetscDSGetNumFields(ds, &Nf));
  const PetscInt test = key.field / Nf, trial = key.field % Nf;
  PetscCall(PetscWeakFormGetBdJacobian(wf, key.label, key.value, test, trial, key.part, &c.n0, &c.g0, &c.n1, &c.g1,
                                       &c.n2, &c.g2, &c.n3, &c.g3));
  if (c.count() == 0 || Ne == 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(check_geometry(geom));
  PetscCall(PetscDSGetFaceTabulation(ds, &T));
  PetscCall(PetscDSGetDiscretization(ds, 0, (PetscObject *)&fe));
  PetscCall(PetscFEGetFaceQuadrature(fe, &rule));
  PetscCall(PetscQuadratureGetData(rule, nullptr, nullptr, &Nq, &reference, &weights));
  PetscCall(PetscDSGetConstants(ds, &nc, &constants));
  PetscCall(IntegrationLog::find(ds, &log));

  Scratch tables(4 * fields_scratch(Nf, T, 1));
  Fields faces[4];
  for (PetscInt i = 0; i < 4; ++i) PetscCall(make_fields(ds, T, i, tables, faces[i]));
  const PetscInt size = faces[0].element_size,
                 pairs = faces[0].basis[test].components * faces[0].basis[trial].components;
  for (PetscInt e = 0; e < Ne; ++e) {
    const Fields &fields = faces[geom->face[e][0]];
    Scratch work(PointData::scratch_size(fields) + MatrixBuilder::scratch_size(fields) + 4 * Scratch::padded(Nq * 81));
    PointData data(fields, work);
    const MatrixBuilder builder(data, work);
    PetscScalar *g0 = work.take(Nq * pairs), *g1 = work.take(Nq * pairs * dim), *g2 = work.take(Nq * pairs * dim),
                *g3 = work.take(Nq * pairs * dim * dim);
    const Caller call(data, t, shift, nc, constants, log);
    data.evaluate(geom->suppInvJ[0] + e * geom->numPoints * dim * dim, coefficients + e * size,
                  coefficients_t ? coefficients_t + e * size : nullptr);
    face_points(geom, e, weights, data);
    face_coordinates(geom, e, Nq, reference, data.x);
    for (PetscInt i = 0; i < c.n0; ++i) call.surface(c.g0[i], g0, pairs);
    for (PetscInt i = 0; i < c.n1; ++i) call.surface(c.g1[i], g1, pairs * dim);
    for (PetscInt i = 0; i < c.n2; ++i) call.surface(c.g2[i], g2, pairs * dim);
    for (PetscInt i = 0; i < c.n3; ++i) call.surface(c.g3[i], g3, pairs * dim * dim);
    builder.add(test, trial, c.n0 ? g0 : nullptr, c.n1 ? g1 : nullptr, c.n2 ? g2 : nullptr, c.n3 ? g3 : nullptr,
                matrices + e * size * size);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
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

} // namespace

PetscErrorCode IntegrationLog::attach(PetscDS ds, IntegrationLog *log)
{
  PetscContainer container;

  PetscFunctionBeginUser;
  PetscCall(PetscContainerCreate(PETSC_COMM_SELF, &container));
  PetscCall(PetscContainerSetPointer(container, log));
  PetscCall(PetscObjectCompose((PetscObject)ds, "pulmo_integration_log", (PetscObject)container));
  PetscCall(PetscContainerDestroy(&container));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode IntegrationLog::find(PetscDS ds, IntegrationLog **log)
{
  PetscContainer container;
  void *pointer = nullptr;

  PetscFunctionBeginUser;
  PetscCall(PetscObjectQuery((PetscObject)ds, "pulmo_integration_log", (PetscObject *)&container));
  if (container) PetscCall(PetscContainerGetPointer(container, &pointer));
  *log = static_cast<IntegrationLog *>(pointer);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode register_fe_type()
{
  PetscFunctionBeginUser;
  PetscCall(PetscFERegister("pulmo", create_fe));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
