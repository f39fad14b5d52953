/// @file
/// PETSc as pulmo uses it: version compatibility, owning handles, errors that a user can fix.
#pragma once

#include <petscdmplex.h>
#include <petscds.h>
#include <petscsf.h>
#include <petscts.h>

#include <cstdint>
#include <string>
#include <utility>

#if PETSC_VERSION_LT(3, 18, 0)
#error "pulmo needs PETSc 3.18 or newer"
#endif

// PETSc 3.19 turned error codes into an enum and named its zero.
#ifndef PETSC_SUCCESS
#define PETSC_SUCCESS static_cast<PetscErrorCode>(0)
#endif

/// What the program ends with (docs/running.md); the same on every rank.
enum PulmoExitCode : int { PULMO_FINISHED = 0, PULMO_WRONG_INPUT = 1, PULMO_COULD_NOT_GO_ON = 2, PULMO_STOPPED = 3 };

/// Error codes of a run that could not go on and of one that a signal stopped; PETSc's own codes end far below.
#define PULMO_ERR_COULD_NOT_GO_ON static_cast<PetscErrorCode>(13002)
#define PULMO_ERR_STOPPED static_cast<PetscErrorCode>(13003)

/// Each ends the calling function with an error that is one sentence without a stack trace, PulmoUserError with one
/// that is the input's fault, PulmoFailure with one that is not, PulmoStopped once there is a checkpoint to go on from.
/// Collective: every rank of the communicator must reach it with the same message.
#define PulmoUserError(comm, ...) SETERRQ(comm, PETSC_ERR_USER_INPUT, __VA_ARGS__)
#define PulmoFailure(comm, ...) SETERRQ(comm, PULMO_ERR_COULD_NOT_GO_ON, __VA_ARGS__)
#define PulmoStopped(comm, ...) SETERRQ(comm, PULMO_ERR_STOPPED, __VA_ARGS__)

/// PulmoUserError unless @p condition holds.
#define PulmoUserCheck(condition, comm, ...)                                                                           \
  do {                                                                                                                 \
    if (PetscUnlikely(!(condition))) PulmoUserError(comm, __VA_ARGS__);                                                \
  } while (0)

/// PulmoFailure unless @p condition holds.
#define PulmoFailureCheck(condition, comm, ...)                                                                        \
  do {                                                                                                                 \
    if (PetscUnlikely(!(condition))) PulmoFailure(comm, __VA_ARGS__);                                                  \
  } while (0)

namespace pulmo {

/// Calls to PETSc whose arguments changed after 3.18; the overload that fits the installed PETSc is taken. (Only 3.18
/// is tested.)
namespace compat {

#define PULMO_FE_ARGUMENTS                                                                                             \
  PetscFormKey key, PetscInt n, PetscFEGeom *geom, const PetscScalar *u, const PetscScalar *u_t, PetscReal t,          \
      PetscReal shift, PetscScalar *matrices
#define PULMO_BD_ARGUMENTS                                                                                             \
  PetscFormKey key, PetscInt n, PetscFEGeom *geom, const PetscScalar *u, const PetscScalar *u_t, PetscDS aux,          \
      PetscReal t, PetscReal shift, PetscScalar *matrices
#define PULMO_FE_TYPES                                                                                                 \
  PetscFormKey, PetscInt, PetscFEGeom *, const PetscScalar *, const PetscScalar *, PetscDS, const PetscScalar *,       \
      PetscReal, PetscReal, PetscScalar *

/// PetscFEIntegrateJacobian: newer releases take a PetscDS for rows and one for columns.
inline PetscErrorCode integrate_jacobian(PetscErrorCode (*f)(PetscDS, PetscFEJacobianType, PULMO_FE_TYPES), PetscDS ds,
                                         PULMO_FE_ARGUMENTS)
{
  return f(ds, PETSCFE_JACOBIAN, key, n, geom, u, u_t, nullptr, nullptr, t, shift, matrices);
}
inline PetscErrorCode integrate_jacobian(PetscErrorCode (*f)(PetscDS, PetscDS, PetscFEJacobianType, PULMO_FE_TYPES),
                                         PetscDS ds, PULMO_FE_ARGUMENTS)
{
  return f(ds, ds, PETSCFE_JACOBIAN, key, n, geom, u, u_t, nullptr, nullptr, t, shift, matrices);
}

/// PetscFEIntegrateBdJacobian, with the rates as auxiliary field: newer releases take the type of the Jacobian.
inline PetscErrorCode integrate_bd_jacobian(PetscErrorCode (*f)(PetscDS, PetscWeakForm, PULMO_FE_TYPES), PetscDS ds,
                                            PetscWeakForm wf, PULMO_BD_ARGUMENTS)
{
  return f(ds, wf, key, n, geom, u, u_t, aux, u_t, t, shift, matrices);
}
inline PetscErrorCode integrate_bd_jacobian(PetscErrorCode (*f)(PetscDS, PetscWeakForm, PetscFEJacobianType,
                                                                PULMO_FE_TYPES),
                                            PetscDS ds, PetscWeakForm wf, PULMO_BD_ARGUMENTS)
{
  return f(ds, wf, PETSCFE_JACOBIAN, key, n, geom, u, u_t, aux, u_t, t, shift, matrices);
}

#undef PULMO_FE_ARGUMENTS
#undef PULMO_BD_ARGUMENTS
#undef PULMO_FE_TYPES

} // namespace compat

/// Owns one PETSc object and destroys it with @p Destroy. Movable, not copyable.
template <class T, PetscErrorCode (*Destroy)(T *)>
class Handle {
public:
  Handle() = default;
  ~Handle() { reset(); }
  Handle(const Handle &) = delete;
  Handle &operator=(const Handle &) = delete;
  Handle(Handle &&other) noexcept : object_(std::exchange(other.object_, nullptr)) {}
  Handle &operator=(Handle &&other) noexcept
  {
    if (this != &other) {
      reset();
      object_ = std::exchange(other.object_, nullptr);
    }
    return *this;
  }

  operator T() const { return object_; }
  /// For PETSc's creating functions: destroys what is held and gives the place of the new object.
  T *out()
  {
    reset();
    return &object_;
  }
  void reset()
  {
    if (object_) (void)Destroy(&object_);
    object_ = nullptr;
  }

private:
  T object_ = nullptr;
};

using DMHandle = Handle<DM, DMDestroy>;
using FEHandle = Handle<PetscFE, PetscFEDestroy>;
using ISHandle = Handle<IS, ISDestroy>;
using MatHandle = Handle<Mat, MatDestroy>;
using QuadratureHandle = Handle<PetscQuadrature, PetscQuadratureDestroy>;
using SectionHandle = Handle<PetscSection, PetscSectionDestroy>;
using SFHandle = Handle<PetscSF, PetscSFDestroy>;
using TSHandle = Handle<TS, TSDestroy>;
using VecHandle = Handle<Vec, VecDestroy>;

/// Makes what rank 0 knows known to all ranks.
inline PetscErrorCode from_root(MPI_Comm comm, bool &value)
{
  int v = value;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Bcast(&v, 1, MPI_INT, 0, comm));
  value = v != 0;
  PetscFunctionReturn(PETSC_SUCCESS);
}
inline PetscErrorCode from_root(MPI_Comm comm, std::string &text)
{
  std::uint64_t n = text.size();

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Bcast(&n, 1, MPI_UINT64_T, 0, comm));
  text.resize(n);
  PetscCallMPI(MPI_Bcast(text.data(), static_cast<PetscMPIInt>(n), MPI_CHAR, 0, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Read access to the entries of a Vec for the life of this object.
class ReadArray {
public:
  explicit ReadArray(Vec v) : vec_(v) { (void)VecGetArrayRead(vec_, &data_); }
  ~ReadArray() { (void)VecRestoreArrayRead(vec_, &data_); }
  ReadArray(const ReadArray &) = delete;
  ReadArray &operator=(const ReadArray &) = delete;
  const PetscScalar *data() const { return data_; }
  PetscScalar operator[](PetscInt i) const { return data_[i]; }

private:
  Vec vec_;
  const PetscScalar *data_ = nullptr;
};

/// Write access to the entries of a Vec for the life of this object.
class WriteArray {
public:
  explicit WriteArray(Vec v) : vec_(v) { (void)VecGetArray(vec_, &data_); }
  ~WriteArray() { (void)VecRestoreArray(vec_, &data_); }
  WriteArray(const WriteArray &) = delete;
  WriteArray &operator=(const WriteArray &) = delete;
  PetscScalar *data() { return data_; }
  PetscScalar &operator[](PetscInt i) { return data_[i]; }

private:
  Vec vec_;
  PetscScalar *data_ = nullptr;
};

} // namespace pulmo
