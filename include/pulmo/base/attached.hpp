/// @file
/// Objects of C++ that hang on an object of PETSc's by a name.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

namespace detail {

/// @p own: the content is deleted with the last reference.
template <class T>
PetscErrorCode attach(PetscObject object, const char *name, T *content, bool own)
{
  PetscContainer container;

  PetscFunctionBeginUser;
  PetscCall(PetscContainerCreate(PetscObjectComm(object), &container));
  PetscCall(PetscContainerSetPointer(container, content));
  if (own) {
#if PETSC_VERSION_LT(3, 23, 0)
    PetscCall(PetscContainerSetUserDestroy(container, [](void *p) {
      delete static_cast<T *>(p);
      return PetscErrorCode(0);
    }));
#else
    PetscCall(PetscContainerSetCtxDestroy(container, [](void **p) {
      delete static_cast<T *>(*p);
      return PetscErrorCode(0);
    }));
#endif
  }
  PetscCall(PetscObjectCompose(object, name, (PetscObject)container));
  PetscCall(PetscContainerDestroy(&container));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace detail

/// @p content must outlive @p object.
template <class T>
PetscErrorCode attach_pointer(PetscObject object, const char *name, T *content)
{
  return detail::attach(object, name, content, false);
}

/// @p object deletes @p content in the end.
template <class T>
PetscErrorCode attach_owned(PetscObject object, const char *name, T *content)
{
  return detail::attach(object, name, content, true);
}

/// Null if there is nothing of that name.
template <class T>
PetscErrorCode find_attached(PetscObject object, const char *name, T **content)
{
  PetscContainer container;
  void *found = nullptr;

  PetscFunctionBeginUser;
  PetscCall(PetscObjectQuery(object, name, (PetscObject *)&container));
  if (container) PetscCall(PetscContainerGetPointer(container, &found));
  *content = static_cast<T *>(found);
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
