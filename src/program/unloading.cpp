// The stress-free shape of a lung whose mesh is under load: Newton's method on where its tissue goes.
#include "pulmo/program/unloading.hpp"

#include "pulmo/fem/pins.hpp"
#include "pulmo/fem/point_memory.hpp"
#include "pulmo/fem/sampling.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/program/prestress_notes.hpp"
#include "pulmo/solvers/preconditioning.hpp"
#include "pulmo/solvers/rigid_body_modes.hpp"

#include <cmath>

namespace pulmo {

namespace {

/// A share of the load less than this is not tried.
constexpr PetscReal least_share = 1. / 64;
/// A shape is not solved where more than this share of the load is left.
constexpr PetscReal unsolved = 1e-4;
/// Rounding may leave as much of no load.
constexpr PetscReal rounding = 1e-12;
/// A moment is not told where the weight acts by less than this from the centre, over the size of the lung.
constexpr PetscReal faint_arm = 1e-3;

using Vector3 = std::array<PetscReal, 3>;

Vector3 cross(const Vector3 &a, const Vector3 &b)
{
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

PetscReal length(const Vector3 &a)
{
  return std::hypot(a[0], a[1], a[2]);
}

/// The equations of the stress-free shape, for SNES.
class UnloadedShape {
public:
  /// @p composition: the terms of the problem, pins included.
  PetscErrorCode setup(const Model &like, Composition composition, PetscReal modulus);
  /// Tells all points what balances the weight, body by body. @p pleura: of this, what pressure on the pleura can do;
  /// the rest are couples. @p arm: how far the weight acts from the centre of the volume, mm. Collective.
  PetscErrorCode balance(Unloading &unloading, std::vector<Vector3> &pleura, PetscReal &arm);
  /// Solves under the whole load, or under the largest @p share of it that Newton's method comes to. @p loaded: norm of
  /// the residual of the mesh itself under the load; @p left: of the solution.
  PetscErrorCode solve(PetscReal &share, PetscReal &loaded, PetscReal &left);
  /// Fills F0 of all points, and the volume of the shape; of what balances the weight leaves that of the pleura.
  /// Collective.
  PetscErrorCode result(Unloading &unloading, const std::vector<Vector3> &pleura);

private:
  static PetscErrorCode residual(SNES snes, Vec X, Vec F, void *self);
  static PetscErrorCode jacobian(SNES snes, Vec X, Mat A, Mat P, void *self);
  /// Fills local_ from @p X.
  PetscErrorCode scatter(Vec X);
  PetscErrorCode try_share(PetscReal share, bool &solved);
  /// Of the residual of X_ under the whole load.
  PetscErrorCode norm(PetscReal &value);

  Model model_;
  Sampling sampling_;
  SNESHandle snes_;
  MatHandle matrix_;
  VecHandle X_, kept_, local_, rest_, local_residual_;
};

PetscErrorCode UnloadedShape::setup(const Model &like, Composition composition, PetscReal modulus)
{
  std::string pc;
  KSP ksp;

  PetscFunctionBeginUser;
  const MPI_Comm comm = PetscObjectComm((PetscObject)composition.mesh().dm());
  model_.integrate_as(like);
  PetscCall(model_.build(std::move(composition), modulus));
  PetscCall(sampling_.setup(model_));
  PetscCall(wanted_pc(comm, pc));
  PulmoUserCheck(
      pc != PCCHOLESKY, comm,
      "-pc_type cholesky needs a symmetric matrix, and that of -prestress_method inverse is not; use -pc_type lu");
  if (pc != PCLU) PetscCall(attach_rigid_body_modes(model_.dm()));
  PetscCall(model_.create_matrix(matrix_.out()));
  PetscCall(DMCreateGlobalVector(model_.dm(), X_.out()));
  PetscCall(VecDuplicate(X_, kept_.out()));
  PetscCall(DMCreateLocalVector(model_.dm(), local_.out()));
  PetscCall(VecDuplicate(local_, rest_.out()));
  PetscCall(VecDuplicate(local_, local_residual_.out()));
  PetscCall(VecZeroEntries(X_));
  PetscCall(VecZeroEntries(rest_));
  PetscCall(SNESCreate(comm, snes_.out()));
  PetscCall(SNESSetDM(snes_, model_.dm()));
  PetscCall(SNESSetFunction(snes_, nullptr, residual, this));
  PetscCall(SNESSetJacobian(snes_, matrix_, matrix_, jacobian, this));
  PetscCall(SNESGetKSP(snes_, &ksp));
  PetscCall(precondition_one_field(ksp));
  PetscCall(SNESSetFromOptions(snes_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode UnloadedShape::scatter(Vec X)
{
  PetscFunctionBeginUser;
  PetscCall(DMGlobalToLocal(model_.dm(), X, INSERT_VALUES, local_));
  PetscCall(model_.constrain(0, local_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode UnloadedShape::residual(SNES snes, Vec X, Vec F, void *context)
{
  auto &self = *static_cast<UnloadedShape *>(context);
  Measures measures;

  PetscFunctionBeginUser;
  PetscCall(self.scatter(X));
  PetscCall(self.model_.measure(self.local_, measures));
  if (!(measures.min_J_points > 0)) {
    PetscCall(SNESSetFunctionDomainError(snes));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(self.model_.residual(0, self.local_, self.rest_, self.local_residual_));
  PetscCall(VecZeroEntries(F));
  PetscCall(DMLocalToGlobal(self.model_.dm(), self.local_residual_, ADD_VALUES, F));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode UnloadedShape::jacobian(SNES, Vec X, Mat A, Mat P, void *context)
{
  auto &self = *static_cast<UnloadedShape *>(context);

  PetscFunctionBeginUser;
  PetscCall(self.scatter(X));
  PetscCall(self.model_.jacobian(0, self.local_, self.rest_, 0, P));
  if (A != P) { // -snes_mf_operator
    PetscCall(MatAssemblyBegin(A, MAT_FINAL_ASSEMBLY));
    PetscCall(MatAssemblyEnd(A, MAT_FINAL_ASSEMBLY));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode UnloadedShape::try_share(PetscReal share, bool &solved)
{
  SNESConvergedReason reason;

  PetscFunctionBeginUser;
  model_.set_load(share);
  PetscCall(model_.set_step(Stage(1, 0, true), 0));
  PetscCall(SNESSolve(snes_, nullptr, X_));
  PetscCall(SNESGetConvergedReason(snes_, &reason));
  solved = reason > 0;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode UnloadedShape::norm(PetscReal &value)
{
  PetscFunctionBeginUser;
  model_.set_load(1);
  PetscCall(model_.set_step(Stage(1, 0, true), 0));
  PetscCall(SNESComputeFunction(snes_, X_, kept_));
  PetscCall(VecNorm(kept_, NORM_2, &value));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode UnloadedShape::solve(PetscReal &share, PetscReal &loaded, PetscReal &left)
{
  PetscReal step = 1;
  bool solved = false;

  PetscFunctionBeginUser;
  PetscCall(model_.memory()->begin());
  PetscCall(norm(loaded));
  share = 0;
  while (share < 1 && step >= least_share) {
    PetscCall(VecCopy(X_, kept_));
    PetscCall(try_share(std::min<PetscReal>(1, share + step), solved));
    if (solved) {
      share = std::min<PetscReal>(1, share + step);
    } else {
      PetscCall(VecCopy(kept_, X_));
      step /= 2;
    }
  }
  PetscCall(norm(left));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode UnloadedShape::result(Unloading &unloading, const std::vector<Vector3> &pleura)
{
  std::vector<PointSample> samples;

  PetscFunctionBeginUser;
  PetscCall(scatter(X_));
  unloading.volume = 0;
  const ReadArray values(local_);
  PetscScalar *point = unloading.points->data();
  for (const Sampling::Element &e : sampling_.cells()) {
    const std::vector<PetscReal> &weights = sampling_.weights(e);
    sampling_.sample(e, values.data(), samples);
    for (std::size_t q = 0; q < samples.size(); ++q, point += Unloading::AtPoint::count) {
      const PointState &f = samples[q].state;
      unloading.volume += weights[q] * e.measure * f.J;
      std::copy_n(pleura[e.cell].data(), 3, point + Unloading::AtPoint::gradient);
      for (int i = 0; i < 3; ++i)
        for (int J = 0; J < 3; ++J) point[Unloading::AtPoint::F0 + 3 * i + J] = f.cof_F[3 * J + i] / f.J;
    }
  }
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, &unloading.volume, 1, MPIU_REAL, MPI_SUM, PetscObjectComm((PetscObject)model_.dm())));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode UnloadedShape::balance(Unloading &unloading, std::vector<Vector3> &pleura, PetscReal &arm)
{
  using At = Unloading::AtPoint;
  const MPI_Comm comm = PetscObjectComm((PetscObject)model_.dm());
  const PetscInt points = sampling_.points_of_cell();
  std::vector<Mesh::Body> bodies;
  std::vector<PetscReal> x;

  PetscFunctionBeginUser;
  arm = 0;
  unloading.points->clear();
  pleura.assign(sampling_.cells().size(), {0, 0, 0});
  const At start(unloading.pressure);
  for (std::size_t i = 0; i < sampling_.cells().size() * static_cast<std::size_t>(points); ++i)
    unloading.points->insert(unloading.points->end(), start.begin(), start.end());
  if (!unloading.weight) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(model_.composition().mesh().bodies(bodies));
  for (const Mesh::Body &body : bodies) {
    PetscReal sum[12] = {0}; // weight, its moment, second moments of the volume
    const auto at_points = [&](auto &&visit) {
      for (const PetscInt c : body.cells) {
        const Sampling::Element &e = sampling_.cells()[c];
        Vector3 weight, r;
        unloading.weight(model_.constants_at(c), weight.data());
        sampling_.coordinates(e, x);
        for (PetscInt q = 0; q < points; ++q) {
          for (int d = 0; d < 3; ++d) r[d] = x[3 * q + d] - body.centroid[d];
          visit(c, q, sampling_.weights(e)[q] * e.measure, weight, r);
        }
      }
    };
    at_points([&](PetscInt, PetscInt, PetscReal dV, const Vector3 &w, const Vector3 &r) {
      const Vector3 moment = cross(r, w);
      for (int d = 0; d < 3; ++d) {
        sum[d] += dV * w[d];
        sum[3 + d] += dV * moment[d];
      }
      for (int i = 0, n = 6; i < 3; ++i)
        for (int j = i; j < 3; ++j) sum[n++] += dV * r[i] * r[j];
    });
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sum, 12, MPIU_REAL, MPI_SUM, comm));
    const Vector3 load{sum[0], sum[1], sum[2]}, moment{sum[3], sum[4], sum[5]}; // kPa mm^2, kPa mm^3
    const PetscReal *m = sum + 6;                                               // xx xy xz yy yz zz
    const PetscReal inertia[9] = {m[3] + m[5], -m[1], -m[2], -m[1], m[0] + m[5], -m[4], -m[2], -m[4], m[0] + m[3]};
    PetscReal cof[9];
    cofactor(inertia, cof);
    const PetscReal det = determinant(inertia);
    Vector3 turn; // theta with I theta = -moment
    for (int i = 0; i < 3; ++i)
      turn[i] = -(cof[3 * i] * moment[0] + cof[3 * i + 1] * moment[1] + cof[3 * i + 2] * moment[2]) / det;
    const PetscReal size = length(load);
    if (size > 0) arm = std::max(arm, length(moment) / size);
    at_points([&](PetscInt c, PetscInt q, PetscReal, const Vector3 &, const Vector3 &r) {
      PetscScalar *point = unloading.points->data() + (c * points + q) * At::count;
      const Vector3 couple = cross(turn, r);
      for (int d = 0; d < 3; ++d) {
        pleura[c][d] = -load[d] / body.volume;
        point[At::pleural] += pleura[c][d] * r[d];
        point[At::gradient + d] = pleura[c][d] + couple[d];
      }
    });
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode solve_unloaded_shape(Options &options, const Scene &scene, const Model &model,
                                    const Composition &composition, PetscReal modulus)
{
  if (!scene.facts().prestress || !scene.facts().prestress->unloading) return PETSC_SUCCESS;
  Unloading &unloading = *scene.facts().prestress->unloading;
  UnloadedShape shape;
  std::vector<Vector3> pleura;
  PetscReal share, loaded, arm;
  std::string weak;

  PetscFunctionBeginUser;
  Composition problem = composition.without_terms();
  problem.speaker("prestress");
  unloading.terms(problem);
  problem.pin_free_motions();
  PetscCall(pin_free_motions(problem));
  PetscCall(shape.setup(model, std::move(problem), modulus));
  PetscCall(shape.balance(unloading, pleura, arm));
  if (arm > faint_arm * std::cbrt(scene.mesh().volume()))
    PetscCall(
        PetscPrintf(options.comm(),
                    "pulmo: note: -prestress_method inverse: the weight acts %.3g mm from the centre of a lung's "
                    "volume; no pressure on the pleura carries that moment, so whatever else holds the lung does, "
                    "and it turns a little before it breathes\n",
                    (double)arm));
  PetscCall(shape.solve(share, loaded, unloading.left));
  if (share < 1) PetscCall(find_weak_part(scene, composition, weak));
  PulmoUserCheck(weak.empty(), options.comm(),
                 "-prestress_method inverse: no unloaded shape was found beyond %.3g of the load (transpulmonary "
                 "pressure and weight): %s, and -prestress_pressure is %g cmH2O; give less, or that part other "
                 "parameters",
                 (double)share, weak.c_str(), (double)(scene.facts().prestress->pressure / units::kPa_per_cmH2O));
  PulmoUserCheck(share >= 1, options.comm(),
                 "-prestress_method inverse: no unloaded shape was found beyond %.3g of the load (transpulmonary "
                 "pressure and weight); lower -prestress_pressure, take another law, or another solver file "
                 "(petsc_options/solvers/direct.opts)",
                 (double)share);
  PulmoUserCheck(unloading.left <= std::max(rounding, unsolved * loaded), options.comm(),
                 "-prestress_method inverse: the unloaded shape is hardly solved: %.2g of the load is not in balance; "
                 "lower -snes_rtol and -snes_atol",
                 (double)(unloading.left / loaded));
  PetscCall(shape.result(unloading, pleura));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
