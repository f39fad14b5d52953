// Text files that an option names, on all ranks.
#include "pulmo/input/user_file.hpp"

#include "pulmo/base/text_file.hpp"
#include "pulmo/input/errors.hpp"

namespace pulmo {

PetscErrorCode read_user_file(MPI_Comm comm, const std::string &option, const std::string &file, std::size_t most,
                              const std::string &what, std::string &text)
{
  PetscMPIInt rank;
  bool readable = false;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  text.clear();
  if (rank == 0) readable = read_text(file, most + 1, text);
  PetscCall(from_root(comm, readable));
  PulmoUserCheck(readable, comm, "cannot read %s (%s); check its name", file.c_str(), option.c_str());
  PetscCall(from_root(comm, text));
  PulmoUserCheck(text.size() <= most, comm, "%s (%s) has more than %d MB: it is no %s; check its name", file.c_str(),
                 option.c_str(), (int)(most >> 20), what.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
