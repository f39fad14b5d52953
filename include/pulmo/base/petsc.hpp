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

// 3.24 renamed these types of functions and warns of the old names, which pulmo keeps for 3.18.
#if PETSC_VERSION_GE(3, 24, 0)
using PetscPointFunc = PetscPointFn *;
using PetscPointJac = PetscPointJacFn *;
using PetscBdPointFunc = PetscBdPointFn *;
using PetscBdPointJac = PetscBdPointJacFn *;
#endif

/// What changed in PETSc after 3.18, up to 3.25: arguments of calls, names of types and of options.
namespace compat {

/// What PC types read their options from.
#if PETSC_VERSION_LT(3, 23, 0)
using OptionItems = PetscOptionItems *;
#else
using OptionItems = PetscOptionItems;
#endif

/// What a partitioner is handed of weights, before the section of its result: 3.21 added those of edges.
#if PETSC_VERSION_LT(3, 21, 0)
#define PULMO_PARTITION_WEIGHTS PetscSection, PetscSection
#else
#define PULMO_PARTITION_WEIGHTS PetscSection, PetscSection, PetscSection
#endif

/// All fields, of any degree.
inline PetscErrorCode copy_fields(DM from, DM to)
{
#if PETSC_VERSION_LT(3, 22, 0)
  return DMCopyFields(from, to);
#else
  return DMCopyFields(from, PETSC_DETERMINE, PETSC_DETERMINE, to);
#endif
}

/// The geometry of facets of the boundary.
inline PetscErrorCode create_facet_geometry(DMField coordinates, IS facets, PetscQuadrature rule,
                                            PetscFEGeom **geometry)
{
#if PETSC_VERSION_LT(3, 23, 0)
  return DMFieldCreateFEGeom(coordinates, facets, rule, PETSC_TRUE, geometry);
#else
  return DMFieldCreateFEGeom(coordinates, facets, rule, PETSC_FEGEOM_BOUNDARY, geometry);
#endif
}

/// Lets a KSP keep its matrix where its DM could make one.
inline PetscErrorCode keep_operators(KSP ksp)
{
#if PETSC_VERSION_LT(3, 25, 0)
  return KSPSetDMActive(ksp, PETSC_FALSE);
#else
  return KSPSetDMActive(ksp, KSP_DMACTIVE_ALL, PETSC_FALSE);
#endif
}

/// An option, or the value of one, with another name in later releases. Those that pulmo refuses
/// (src/input/refused_options.cpp: -ts_max_reject) are refused there by either name.
struct RenamedOption {
  const char *name, *later; ///< pulmo's files and docs say @p name
  bool later_here;          ///< this PETSc knows @p later only
};
inline constexpr RenamedOption renamed_options[] = {
    {"-ts_dt", "-ts_time_step", PETSC_VERSION_GE(3, 25, 0)},
    {"-snes_linesearch_maxstep", "-snes_linesearch_maxlambda", PETSC_VERSION_GE(3, 24, 0)}};
inline constexpr RenamedOption renamed_line_search = {"l2", "secant", PETSC_VERSION_GE(3, 24, 0)};

/// Moves the value of option @p from to @p to. Both given: an error, since the database forgets which came last.
inline PetscErrorCode move_option(MPI_Comm comm, const char *from, const char *to)
{
  char value[4096] = "";
  PetscBool given, both;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsHasName(nullptr, nullptr, from, &given));
  if (!given) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscOptionsHasName(nullptr, nullptr, to, &both));
  PulmoUserCheck(
      !both, comm,
      "options %s and %s are two names of the same, and an option file may give the first; write %s everywhere", to,
      from, to);
  PetscCall(PetscOptionsGetString(nullptr, nullptr, from, value, sizeof(value), nullptr));
  PetscCall(PetscOptionsSetValue(nullptr, to, value[0] ? value : nullptr));
  PetscCall(PetscOptionsClearValue(nullptr, from));
  PetscCall(PetscOptionsHasName(nullptr, nullptr, to, &given)); // that is use enough for -options_left
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Changes the type of the line search from one name to the other.
inline PetscErrorCode rename_line_search(const char *from, const char *to)
{
  char value[64] = "";
  PetscBool same;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsGetString(nullptr, nullptr, "-snes_linesearch_type", value, sizeof(value), nullptr));
  PetscCall(PetscStrcmp(value, from, &same));
  if (same) PetscCall(PetscOptionsSetValue(nullptr, "-snes_linesearch_type", to));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Options that a user gave by their later names get those that pulmo knows.
inline PetscErrorCode settle_option_names(MPI_Comm comm)
{
  PetscFunctionBeginUser;
  for (const RenamedOption &option : renamed_options) PetscCall(move_option(comm, option.later, option.name));
  PetscCall(rename_line_search(renamed_line_search.later, renamed_line_search.name));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Keeps later releases from listing unused options at the end unasked: pulmo tells of them itself.
inline PetscErrorCode leave_unused_options_to_pulmo()
{
  PetscBool given;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsHasName(nullptr, nullptr, "-options_left", &given));
  if (!given) PetscCall(PetscOptionsSetValue(nullptr, "-options_left", "no"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// TSSetFromOptions, which finds the options by the names that this PETSc knows.
inline PetscErrorCode set_from_options(TS ts)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)ts);

  PetscFunctionBeginUser;
  for (const RenamedOption &option : renamed_options)
    if (option.later_here) PetscCall(move_option(comm, option.name, option.later));
  if (renamed_line_search.later_here)
    PetscCall(rename_line_search(renamed_line_search.name, renamed_line_search.later));
  PetscCall(TSSetFromOptions(ts));
  PetscCall(settle_option_names(comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

#define PULMO_FE_ARGUMENTS                                                                                             \
  PetscFormKey key, PetscInt n, PetscFEGeom *geom, const PetscScalar *u, const PetscScalar *u_t, PetscDS aux,          \
      PetscReal t, PetscReal shift, PetscScalar *matrices
#define PULMO_FE_TYPES                                                                                                 \
  PetscFormKey, PetscInt, PetscFEGeom *, const PetscScalar *, const PetscScalar *, PetscDS, const PetscScalar *,       \
      PetscReal, PetscReal, PetscScalar *

/// PetscFEIntegrateJacobian, with the rates as auxiliary field: newer releases take a PetscDS for rows and one for
/// columns.
inline PetscErrorCode integrate_jacobian(PetscErrorCode (*f)(PetscDS, PetscFEJacobianType, PULMO_FE_TYPES), PetscDS ds,
                                         PULMO_FE_ARGUMENTS)
{
  return f(ds, PETSCFE_JACOBIAN, key, n, geom, u, u_t, aux, u_t, t, shift, matrices);
}
inline PetscErrorCode integrate_jacobian(PetscErrorCode (*f)(PetscDS, PetscDS, PetscFEJacobianType, PULMO_FE_TYPES),
                                         PetscDS ds, PULMO_FE_ARGUMENTS)
{
  return f(ds, ds, PETSCFE_JACOBIAN, key, n, geom, u, u_t, aux, u_t, t, shift, matrices);
}

/// PetscFEIntegrateBdJacobian, with the rates as auxiliary field: newer releases take the type of the Jacobian.
inline PetscErrorCode integrate_bd_jacobian(PetscErrorCode (*f)(PetscDS, PetscWeakForm, PULMO_FE_TYPES), PetscDS ds,
                                            PetscWeakForm wf, PULMO_FE_ARGUMENTS)
{
  return f(ds, wf, key, n, geom, u, u_t, aux, u_t, t, shift, matrices);
}
inline PetscErrorCode integrate_bd_jacobian(PetscErrorCode (*f)(PetscDS, PetscWeakForm, PetscFEJacobianType,
                                                                PULMO_FE_TYPES),
                                            PetscDS ds, PetscWeakForm wf, PULMO_FE_ARGUMENTS)
{
  return f(ds, wf, PETSCFE_JACOBIAN, key, n, geom, u, u_t, aux, u_t, t, shift, matrices);
}

#undef PULMO_FE_ARGUMENTS
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
using SNESHandle = Handle<SNES, SNESDestroy>;
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
/// What rank @p teller knows.
inline PetscErrorCode from_rank(MPI_Comm comm, PetscMPIInt teller, std::string &text)
{
  std::uint64_t n = text.size();

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Bcast(&n, 1, MPI_UINT64_T, teller, comm));
  text.resize(n);
  PetscCallMPI(MPI_Bcast(text.data(), static_cast<PetscMPIInt>(n), MPI_CHAR, teller, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}
inline PetscErrorCode from_root(MPI_Comm comm, std::string &text)
{
  return from_rank(comm, 0, text);
}
/// The text of the first rank that has any becomes that of all.
inline PetscErrorCode from_first(MPI_Comm comm, std::string &text)
{
  PetscMPIInt rank, size;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  PetscMPIInt first = text.empty() ? size : rank;
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &first, 1, MPI_INT, MPI_MIN, comm));
  if (first < size) PetscCall(from_rank(comm, first, text));
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
