#include "pulmo/fem/integration.hpp"

#include "pulmo/base/simd.hpp"
#include "pulmo/physics/point.hpp"

#include <algorithm>
#include <petsc/private/petscfeimpl.h>

#include <cstdlib>
#include <new>
#include <optional>
#include <type_traits>

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
      : data_(static_cast<PetscScalar *>(std::aligned_alloc(64, (n * sizeof(PetscScalar) + 127) / 64 * 64)))
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
  std::size_t used_ = 0;
};

inline const Vector4 &four(const double *p)
{
  return *reinterpret_cast<const Vector4 *>(p);
}
inline Vector4 &four(double *p)
{
  return *reinterpret_cast<Vector4 *>(p);
}

/// out = s[0] G_0 + s[1] G_1 + s[2] G_2 for three rows of @p n doubles, one after the other; n is a multiple of 4.
inline void combine(PetscInt n, const double s[3], const double *G, double *out)
{
  const double s0 = s[0], s1 = s[1], s2 = s[2];
  for (PetscInt a = 0; a < n; a += 4)
    four(out + a) = s0 * four(G + a) + s1 * four(G + n + a) + s2 * four(G + 2 * n + a);
}

/// K[a][b] += sum_r L[r][a] R[r][b]. Rows of L and R have strides @p lda and @p ldb, rows of K @p ldb.
template <int Rows, int Vectors>
inline void product_tile(PetscInt rank, const double *L, PetscInt lda, const double *R, PetscInt ldb, double *K)
{
  Vector4 sum[Rows][Vectors];
  for (int a = 0; a < Rows; ++a)
    for (int v = 0; v < Vectors; ++v) sum[a][v] = four(K + a * ldb + 4 * v);
  for (PetscInt r = 0; r < rank; ++r) {
    for (int a = 0; a < Rows; ++a) {
      const double l = L[r * lda + a];
      for (int v = 0; v < Vectors; ++v) sum[a][v] += l * four(R + r * ldb + 4 * v);
    }
  }
  for (int a = 0; a < Rows; ++a)
    for (int v = 0; v < Vectors; ++v) four(K + a * ldb + 4 * v) = sum[a][v];
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

inline void product(PetscInt rows, PetscInt rank, const double *L, PetscInt lda, const double *R, PetscInt ldb,
                    double *K)
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
    PetscCheck(Nb / Nc <= max_nodes, PETSC_COMM_SELF, PETSC_ERR_SUP, "more than %d nodes", max_nodes);
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
  const Fields *fields;
  PetscScalar *gradients[max_fields];  ///< [point][dim][stride], real space; for matrices only
  PetscReal inverse_J[dim * dim];      ///< d(reference)/d(real)
  PetscScalar *u, *u_t, *u_x, *rate_x; ///< [point][...] with the offsets of Fields; rate_x: gradients of u_t
  PetscScalar *weights;                ///< quadrature weight times det J
  PetscReal *x, *normals;              ///< [point][3]
  std::vector<PointState> states;
  std::vector<Memory> memory; ///< [point]; empty if nothing is remembered here

  PointData(const Fields &f, Scratch &scratch, bool matrices)
      : fields(&f), states(static_cast<std::size_t>(f.points)), with_gradients(matrices)
  {
    for (PetscInt i = 0; i < f.n; ++i) gradients[i] = scratch.take(f.points * dim * f.basis[i].stride);
    u = scratch.take(f.points * f.total_components);
    u_t = scratch.take(f.points * f.total_components);
    u_x = scratch.take(f.points * f.total_components * dim);
    rate_x = scratch.take(f.points * f.total_components * dim);
    weights = scratch.take(f.points);
    x = scratch.take(f.points * dim);
    normals = scratch.take(f.points * dim);
  }
  static std::size_t scratch_size(const Fields &f)
  {
    std::size_t size = Scratch::padded(f.points) + 2 * Scratch::padded(f.points * dim);
    for (PetscInt i = 0; i < f.n; ++i) size += Scratch::padded(f.points * dim * f.basis[i].stride);
    return size + 4 * Scratch::padded(f.points * f.total_components * dim);
  }

  /// Field values, rates and kinematic states (for matrices the basis' gradients, too) from the element's coefficients.
  void evaluate(const PetscReal inverse[dim * dim], const PetscScalar coefficients[],
                const PetscScalar coefficients_t[])
  {
    std::copy_n(inverse, dim * dim, inverse_J);
    for (PetscInt f = 0; f < fields->n; ++f) {
      interpolate(f, coefficients, coefficients_t);
      if (with_gradients) map_gradients(f);
    }
    for (PetscInt q = 0; q < fields->points; ++q) {
      const PetscInt offset = q * fields->total_components * dim + fields->uOff_x[displacement];
      make_point_state(u_x + offset, rate_x + offset, states[q]);
    }
  }

private:
  void map_gradients(PetscInt f)
  {
    const PetscInt n = fields->basis[f].stride;
    for (PetscInt q = 0; q < fields->points; ++q) {
      for (PetscInt d = 0; d < dim; ++d) {
        const PetscReal s[3] = {inverse_J[d], inverse_J[dim + d], inverse_J[2 * dim + d]};
        combine(n, s, fields->basis[f].derivatives + q * dim * n, gradients[f] + (q * dim + d) * n);
      }
    }
  }

  /// Values and gradients of field @p f and of its rate at all points.
  void interpolate(PetscInt f, const PetscScalar coefficients[], const PetscScalar coefficients_t[])
  {
    const ScalarBasis &basis = fields->basis[f];
    const PetscInt n = basis.stride, C = basis.components, Nc = fields->total_components;
    Vector8 node[max_nodes];
    const auto entry = [&](const PetscScalar *list, PetscInt a, PetscInt c) {
      return list && c < C ? list[basis.offset + a * C + c] : 0;
    };
    for (PetscInt a = 0; a < basis.nodes; ++a) {
      const PetscScalar *e = coefficients, *e_t = coefficients_t;
      node[a] = Vector8{entry(e, a, 0),   entry(e, a, 1),   entry(e, a, 2),   0,
                        entry(e_t, a, 0), entry(e_t, a, 1), entry(e_t, a, 2), 0};
    }
    for (PetscInt q = 0; q < fields->points; ++q) {
      const PetscScalar *B = basis.values + q * n, *D = basis.derivatives + q * dim * n;
      Vector8 s{}, s_0{}, s_1{}, s_2{}; // value, derivatives in the reference cell
      for (PetscInt a = 0; a < basis.nodes; ++a) {
        s += B[a] * node[a];
        s_0 += D[a] * node[a];
        s_1 += D[n + a] * node[a];
        s_2 += D[2 * n + a] * node[a];
      }
      PetscScalar *value = u + q * Nc + fields->uOff[f], *rate = u_t + q * Nc + fields->uOff[f];
      for (PetscInt c = 0; c < C; ++c) {
        value[c] = s[c];
        rate[c] = s[4 + c];
      }
      for (PetscInt d = 0; d < dim; ++d) {
        const Vector8 g = inverse_J[d] * s_0 + inverse_J[dim + d] * s_1 + inverse_J[2 * dim + d] * s_2;
        const PetscInt place = q * Nc * dim + fields->uOff_x[f] + d;
        for (PetscInt c = 0; c < C; ++c) {
          u_x[place + c * dim] = g[c];
          rate_x[place + c * dim] = g[4 + c];
        }
      }
    }
  }

  bool with_gradients;
};

// ------------------------------------------------------------------------------------------------- callbacks

/// Calls one callback at all points of a cell, timed if the log asks for it.
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
    for (PetscInt q = 0; q < data.fields->points; ++q)
      f(dim, data.fields->n, precomputed_state, data.fields->uOff, data.fields->uOff_x, u(q), u_t(q), u_x(q), nullptr,
        data.fields->uOff_x, state(q), memory(q), rate_x(q), t, data.x + q * dim, nc, constants, out + q * stride);
  }
  void operator()(PetscPointJac g, PetscScalar *out, PetscInt stride) const
  {
    const Clock clock(*this, reinterpret_cast<void (*)(void)>(g));
    for (PetscInt q = 0; q < data.fields->points; ++q)
      g(dim, data.fields->n, precomputed_state, data.fields->uOff, data.fields->uOff_x, u(q), u_t(q), u_x(q), nullptr,
        data.fields->uOff_x, state(q), memory(q), rate_x(q), t, shift, data.x + q * dim, nc, constants,
        out + q * stride);
  }
  void operator()(PetscBdPointFunc f, PetscScalar *out, PetscInt stride) const
  {
    const Clock clock(*this, reinterpret_cast<void (*)(void)>(f));
    for (PetscInt q = 0; q < data.fields->points; ++q)
      f(dim, data.fields->n, precomputed_state, data.fields->uOff, data.fields->uOff_x, u(q), u_t(q), u_x(q), nullptr,
        data.fields->uOff_x, state(q), memory(q), rate_x(q), t, data.x + q * dim, data.normals + q * dim, nc, constants,
        out + q * stride);
  }
  void operator()(PetscBdPointJac g, PetscScalar *out, PetscInt stride) const
  {
    const Clock clock(*this, reinterpret_cast<void (*)(void)>(g));
    for (PetscInt q = 0; q < data.fields->points; ++q)
      g(dim, data.fields->n, precomputed_state, data.fields->uOff, data.fields->uOff_x, u(q), u_t(q), u_x(q), nullptr,
        data.fields->uOff_x, state(q), memory(q), rate_x(q), t, shift, data.x + q * dim, data.normals + q * dim, nc,
        constants, out + q * stride);
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

  const PetscScalar *u(PetscInt q) const { return data.u + q * data.fields->total_components; }
  const PetscScalar *u_t(PetscInt q) const { return data.u_t + q * data.fields->total_components; }
  const PetscScalar *u_x(PetscInt q) const { return data.u_x + q * data.fields->total_components * dim; }
  const PetscScalar *rate_x(PetscInt q) const { return data.rate_x + q * data.fields->total_components * dim; }
  const PetscScalar *memory(PetscInt q) const
  {
    return data.memory.empty() ? nullptr : reinterpret_cast<const PetscScalar *>(&data.memory[q]);
  }
  const PetscScalar *state(PetscInt q) const { return reinterpret_cast<const PetscScalar *>(&data.states[q]); }

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

/// vector[node * C + c] += sum_q w (f0_c B + f1_cd G_d), with f1 taken to the reference cell instead of G from it.
void add_to_vector(const PointData &data, PetscInt field, const PetscScalar *f0, const PetscScalar *f1,
                   PetscScalar *vector)
{
  const ScalarBasis &basis = data.fields->basis[field];
  const PetscInt C = basis.components, n = basis.stride;
  const PetscReal *K = data.inverse_J;
  alignas(64) PetscScalar sum[max_nodes];
  for (PetscInt c = 0; c < C; ++c) {
    for (PetscInt a = 0; a < n; ++a) sum[a] = 0;
    for (PetscInt q = 0; q < data.fields->points; ++q) {
      const PetscScalar w = data.weights[q], *B = basis.values + q * n, *D = basis.derivatives + q * dim * n;
      if (f0) {
        const PetscScalar s = w * f0[q * C + c];
        for (PetscInt a = 0; a < n; a += 4) four(sum + a) += s * four(B + a);
      }
      if (f1) {
        const PetscScalar *f = f1 + (q * C + c) * dim;
        PetscScalar s[dim];
        for (PetscInt e = 0; e < dim; ++e)
          s[e] = w * (f[0] * K[e * dim] + f[1] * K[e * dim + 1] + f[2] * K[e * dim + 2]);
        for (PetscInt a = 0; a < n; a += 4)
          four(sum + a) += s[0] * four(D + a) + s[1] * four(D + n + a) + s[2] * four(D + 2 * n + a);
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
    for (PetscInt i = 0; i < d.fields->n; ++i) widest = std::max(widest, Scratch::padded(d.fields->basis[i].stride));
    left = scratch.take(d.fields->points * rows_per_point * widest);
    right = scratch.take(d.fields->points * rows_per_point * widest);
    block = scratch.take(widest * widest);
  }

  /// The rows of R of one pair of components, R[r] = w (sum_d g_rd G_d + g_r B).
  void fill_right(PetscInt trial, PetscInt pair, PetscInt pairs, const PetscScalar *g0, const PetscScalar *g1,
                  const PetscScalar *g2, const PetscScalar *g3) const
  {
    const ScalarBasis &basis = data.fields->basis[trial];
    const PetscInt n = basis.stride;
    PetscScalar *r = right;
    for (PetscInt q = 0; q < data.fields->points; ++q) {
      const PetscScalar w = data.weights[q], *B = basis.values + q * n, *G = data.gradients[trial] + q * dim * n;
      const auto row = [&](const PetscScalar *g, const PetscScalar *value) {
        const PetscScalar v = value ? w * *value : 0;
        if (g) {
          const PetscScalar s[3] = {w * g[0], w * g[1], w * g[2]};
          combine(n, s, G, r);
          if (value)
            for (PetscInt b = 0; b < n; b += 4) four(r + b) += v * four(B + b);
        } else {
          for (PetscInt b = 0; b < n; b += 4) four(r + b) = v * four(B + b);
        }
        r += n;
      };
      const PetscInt place = q * pairs + pair;
      if (g2 || g3)
        for (PetscInt d = 0; d < dim; ++d)
          row(g3 ? g3 + (place * dim + d) * dim : nullptr, g2 ? g2 + place * dim + d : nullptr);
      if (g0 || g1) row(g1 ? g1 + place * dim : nullptr, g0 ? g0 + place : nullptr);
    }
  }

  void add(PetscInt test, PetscInt trial, const PetscScalar *g0, const PetscScalar *g1, const PetscScalar *g2,
           const PetscScalar *g3, PetscScalar *matrix) const
  {
    const ScalarBasis &bi = data.fields->basis[test], &bj = data.fields->basis[trial];
    const PetscInt Ci = bi.components, Cj = bj.components, ni = bi.stride, nj = bj.stride, Nq = data.fields->points;
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
        fill_right(trial, pair, Ci * Cj, g0, g1, g2, g3);
        for (PetscInt i = 0; i < bi.nodes * nj; ++i) block[i] = 0;
        product(bi.nodes, rank, left, ni, right, nj, block);
        for (PetscInt a = 0; a < bi.nodes; ++a) {
          PetscScalar *row = matrix + (bi.offset + a * Ci + c) * data.fields->element_size + bj.offset + e;
          for (PetscInt b = 0; b < bj.nodes; ++b) row[b * Cj] += block[a * nj + b];
        }
      }
    }
  }
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

  const Fields &fields() const { return fields_[0]; }

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
    for (PetscInt q = 0; q < data.fields->points; ++q) {
      data.weights[q] = weights_[q] * geom_->detJ[e * stride];
      for (PetscInt i = 0; i < dim; ++i) {
        data.x[q * dim + i] = v[i];
        for (PetscInt d = 0; d < manifold; ++d)
          data.x[q * dim + i] += J[i * dim + d] * (reference_[q * manifold + d] - origin[d]);
        if (facets_) data.normals[q * dim + i] = geom_->n[e * stride * dim + i];
      }
    }
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
  Fields fields_[4];
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
  const Fields &fields = places.fields();
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
  const Fields &fields = places.fields();
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

PetscErrorCode attach_pointer(PetscDS ds, const char *name, void *pointer)
{
  PetscContainer container;

  PetscFunctionBeginUser;
  PetscCall(PetscContainerCreate(PETSC_COMM_SELF, &container));
  PetscCall(PetscContainerSetPointer(container, pointer));
  PetscCall(PetscObjectCompose((PetscObject)ds, name, (PetscObject)container));
  PetscCall(PetscContainerDestroy(&container));
  PetscFunctionReturn(PETSC_SUCCESS);
}

template <class T>
PetscErrorCode find_pointer(PetscDS ds, const char *name, T **pointer)
{
  PetscContainer container;
  void *found = nullptr;

  PetscFunctionBeginUser;
  PetscCall(PetscObjectQuery((PetscObject)ds, name, (PetscObject *)&container));
  if (container) PetscCall(PetscContainerGetPointer(container, &found));
  *pointer = static_cast<T *>(found);
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode IntegrationLog::attach(PetscDS ds, IntegrationLog *log)
{
  return attach_pointer(ds, log_name, log);
}

PetscErrorCode IntegrationLog::find(PetscDS ds, IntegrationLog **log)
{
  return find_pointer(ds, log_name, log);
}

PetscErrorCode PlaceData::attach(PetscDS ds, PlaceData *places)
{
  return attach_pointer(ds, places_name, places);
}

PetscErrorCode PlaceData::find(PetscDS ds, PlaceData **places)
{
  return find_pointer(ds, places_name, places);
}

PetscErrorCode register_fe_type()
{
  PetscFunctionBeginUser;
  PetscCall(PetscFERegister("pulmo", create_fe));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
