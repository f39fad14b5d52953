#include "pulmo/pulmo.hpp"

#include "pulmo/output.hpp"

namespace pulmo {

namespace {

/// User errors: one sentence from one rank. Everything else: PETSc's trace.
PetscErrorCode handle_error(MPI_Comm comm, int line, const char *function, const char *file, PetscErrorCode code,
                            PetscErrorType type, const char *message, void *context)
{
  if (code != PETSC_ERR_USER_INPUT) return PetscTraceBackErrorHandler(comm, line, function, file, code, type, message, context);
  if (type == PETSC_ERROR_INITIAL) {
    PetscMPIInt rank = 0;
    (void)MPI_Comm_rank(comm, &rank);
    if (rank == 0) {
      std::fflush(stdout);
      std::fprintf(stderr, "pulmo: error: %s\n", message);
    }
  }
  return code;
}

/// Tissue stiffness that scales the equations: the largest diagonal entry of dP'/dF at F = I, kPa.
PetscReal reference_modulus(const TissueLaw &law)
{
  const PetscScalar zero[9] = {0};
  PetscScalar A[81];
  PointState state;
  make_point_state(zero, nullptr, state);
  law.tangent(state, A);
  PetscReal largest = 0;
  for (int i = 0; i < 3; ++i)
    for (int J = 0; J < 3; ++J) largest = std::max(largest, std::abs(A[27 * i + 9 * i + 4 * J]));
  return largest > 0 ? largest : 1;
}

} // namespace

PetscErrorCode initialize()
{
  PetscFunctionBeginUser;
  PetscCall(PetscPushErrorHandler(handle_error, nullptr));
  PetscCall(register_fe_type());
  PetscCall(register_metis_partitioner());
  PetscCall(register_step_control());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode run(const Registry &registry, bool &finished)
{
  const MPI_Comm comm = PETSC_COMM_WORLD;
  Options options(comm);
  Scene scene(registry);
  Model model;
  Output output;
  bool view_effects = false;
  PetscBool help, has_mesh;
  PetscLogDouble start, built;

  PetscFunctionBeginUser;
  finished = false;
  PetscCall(PetscTime(&start));
  PetscCall(scene.declare(options));
  PetscCall(model.declare(options));
  PetscCall(output.declare(options));
  options.group("effects", "ledger");
  PetscCall(options.flag("view", "print effects, fields, terms, blocks and seconds at the end", view_effects));
  PetscCall(PetscOptionsHasHelp(nullptr, &help));
  if (help) {
    PetscCall(options.print_help());
    PetscCall(PetscOptionsHasName(nullptr, nullptr, "-dm_plex_filename", &has_mesh));
    finished = !has_mesh;
    if (!has_mesh) PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(options.check_unknown());
  PetscCall(scene.prepare(options));

  Composition composition(scene.mesh());
  PetscCall(scene.compose(composition));
  PetscCall(model.build(std::move(composition), reference_modulus(scene.tissue().law())));

  Simulation simulation(options, scene, model);
  PetscCall(simulation.setup());
  if (help) { // PETSc has printed what it reads for this scene
    finished = true;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(output.prepare(options));
  PetscCall(PetscTime(&built));
  simulation.setup_took(built - start);

  SignalWriter signals(comm, output, scene.facts());
  ProgressPrinter progress(comm, scene.facts());
  FieldWriter fields(output, scene, model);
  simulation.add(signals);
  simulation.add(fields);
  if (output.progress()) simulation.add(progress);
  PetscCall(simulation.run(finished));
  PetscCall(options.warn_unused());
  if (view_effects) PetscCall(print_ledger(comm, scene, model, simulation.seconds()));
  if (!finished) {
    PetscCall(fields.snapshot(simulation.time(), simulation.local_state()));
    PetscCall(write_summary(options, output, scene, model, simulation, false));
    PulmoUserError(comm, "%s The last good state and the signals so far are in %s.", simulation.failure_text().c_str(),
                   output.directory().c_str());
  }
  PetscCall(signals.finish());
  PetscCall(write_summary(options, output, scene, model, simulation, true));
  PetscCall(print_numbers(comm, output, scene, simulation));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
