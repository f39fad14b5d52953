// The options database: parsing, ranges, mistakes that must end the run with a sentence that says how to fix it.
#include "unit/scenes.hpp"

#include "pulmo/physics/effects/chest_wall.hpp"
#include "pulmo/physics/tissue/berger.hpp"

namespace pulmo::test {
namespace {

using strings = std::vector<std::string>;

/// What is printed when @p call fails with a user error; empty if it succeeds.
std::string error_of(const std::function<PetscErrorCode()> &call)
{
  ::testing::internal::CaptureStderr();
  const PetscErrorCode code = call();
  std::fflush(stderr);
  const std::string text = ::testing::internal::GetCapturedStderr();
  if (code == 0) return "";
  EXPECT_EQ(static_cast<int>(code), static_cast<int>(PETSC_ERR_USER_INPUT)) << text;
  return text.empty() ? "(silent)" : text;
}

/// Error of declaring one option of group `test` from a database.
template <class Declare>
std::string declare(const std::string &database, Declare call)
{
  EXPECT_EQ(static_cast<int>(set_options(database)), 0);
  Options options(PETSC_COMM_WORLD);
  options.group("test", "a group");
  return error_of([&] { return call(options); });
}

#define EXPECT_HAS(text, part) EXPECT_NE((text).find(part), std::string::npos) << (text)

TEST(Options, Numbers)
{
  const auto read = [](const std::string &database, Range range, double &value) {
    return declare(database, [&](Options &o) { return o.real("length", "mm", range, "a length", value); });
  };
  double v = 3;
  EXPECT_EQ(read("", Range::positive(), v), "");
  EXPECT_EQ(v, 3); // the default
  EXPECT_EQ(read("-test_length 2.5e-3", Range::positive(), v), "");
  EXPECT_EQ(v, 2.5e-3);
  EXPECT_EQ(read("-test_length -4", Range::any(), v), "");
  EXPECT_EQ(v, -4);
  EXPECT_EQ(read("-test_length 0", Range::not_negative(), v), "");
  EXPECT_EQ(v, 0);
  EXPECT_EQ(read("-test_length 1", Range::between(0, 1), v), "");

  v = 3;
  for (const char *bad : {"0", "-1e-30"}) {
    const std::string text = read(std::string("-test_length ") + bad, Range::positive(), v);
    EXPECT_HAS(text, "-test_length");
    EXPECT_HAS(text, "mm");
    EXPECT_HAS(text, "> 0");
  }
  EXPECT_HAS(read("-test_length 1.01", Range::between(0, 1), v), "0 <= value <= 1");
  EXPECT_HAS(read("-test_length 1", {0, 1, true}, v), "0 < value < 1");
  EXPECT_HAS(read("-test_length -0.1", Range::not_negative(), v), ">= 0");
  for (const char *bad : {"nan", "inf", "-inf", "abc", "1.5mm", "1,5", "1e999", ""}) {
    const std::string text = read(std::string("-test_length ") + bad, Range::any(), v);
    EXPECT_HAS(text, "-test_length takes a number (mm)");
  }
}

TEST(Options, WholeNumbers)
{
  const auto read = [](const std::string &database, PetscInt &value) {
    return declare(database,
                   [&](Options &o) { return o.whole("count", "-", Range::between(1, 10), "a count", value); });
  };
  PetscInt n = 7;
  EXPECT_EQ(read("", n), "");
  EXPECT_EQ(n, 7);
  EXPECT_EQ(read("-test_count 10", n), "");
  EXPECT_EQ(n, 10);
  EXPECT_HAS(read("-test_count 2.5", n), "whole number");
  EXPECT_HAS(read("-test_count 11", n), "out of range");
  EXPECT_HAS(read("-test_count 0", n), "out of range");
}

TEST(Options, Flags)
{
  const auto read = [](const std::string &database, bool &value) {
    return declare(database, [&](Options &o) { return o.flag("switch", "a switch", value); });
  };
  for (const char *yes : {"", "on", "true", "yes", "1", "ON"}) {
    bool v = false;
    EXPECT_EQ(read(std::string("-test_switch ") + yes, v), "");
    EXPECT_TRUE(v) << yes;
  }
  for (const char *no : {"off", "false", "no", "0", "Off"}) {
    bool v = true;
    EXPECT_EQ(read(std::string("-test_switch ") + no, v), "");
    EXPECT_FALSE(v) << no;
  }
  for (bool initial : {false, true}) {
    bool v = initial;
    EXPECT_EQ(read("-test_other on", v), "");
    EXPECT_EQ(v, initial);
  }
  bool v = false;
  EXPECT_HAS(read("-test_switch perhaps", v), "on or off");
}

TEST(Options, NamesVectorsTextsAndChoices)
{
  strings names{"default"};
  const auto read_names = [&](const std::string &database) {
    return declare(database, [&](Options &o) { return o.names("names", "names", names); });
  };
  EXPECT_EQ(read_names(""), "");
  EXPECT_EQ(names, strings{"default"});
  EXPECT_EQ(read_names("-test_names pleura,airway"), "");
  EXPECT_EQ(names, (strings{"pleura", "airway"}));
  EXPECT_EQ(read_names("-test_names one"), "");
  EXPECT_EQ(names, strings{"one"});
  EXPECT_HAS(read_names("-test_names a,b,a"), "twice");
  EXPECT_HAS(read_names("-test_names ,"), "names nothing");
  EXPECT_HAS(read_names("-test_names"), "names nothing");

  double v[3] = {1, 2, 3};
  const auto read_vector = [&](const std::string &database) {
    return declare(database, [&](Options &o) { return o.vector("force", "kPa", "a vector", v); });
  };
  EXPECT_EQ(read_vector("-test_force -0.5,2e2,0"), "");
  EXPECT_EQ(v[0], -0.5);
  EXPECT_EQ(v[1], 200);
  EXPECT_EQ(v[2], 0);
  EXPECT_HAS(read_vector("-test_force 1,2"), "three numbers (kPa)");
  EXPECT_HAS(read_vector("-test_force 1,2,3,4"), "three numbers");
  EXPECT_HAS(read_vector("-test_force 1,b,3"), "takes a number");
  EXPECT_HAS(read_vector("-test_force 1,nan,3"), "takes a number");

  std::string text = "default";
  const auto read_text = [&](const std::string &database) {
    return declare(database, [&](Options &o) { return o.text("text", "a text", text); });
  };
  EXPECT_EQ(read_text("-test_text xz"), "");
  EXPECT_EQ(text, "xz");
  EXPECT_HAS(read_text("-test_text"), "needs a value");

  std::string choice = "a";
  const auto read_choice = [&](const std::string &database) {
    return declare(database, [&](Options &o) { return o.choice("choice", {"a", "b"}, "a choice", choice); });
  };
  EXPECT_EQ(read_choice(""), "");
  EXPECT_EQ(choice, "a");
  EXPECT_EQ(read_choice("-test_choice b"), "");
  EXPECT_EQ(choice, "b");
  const std::string wrong = read_choice("-test_choice c");
  EXPECT_HAS(wrong, "knows no 'c'");
  EXPECT_HAS(wrong, "a, b");
}

TEST(Options, UnknownNamesUnderAPrefixOfPulmoAreErrors)
{
  const auto check = [](const std::string &database) {
    EXPECT_EQ(static_cast<int>(set_options(database)), 0);
    Options o(PETSC_COMM_WORLD);
    double v = 1;
    o.group("test", "a group");
    EXPECT_EQ(static_cast<int>(o.real("stiffness", "kPa", Range::any(), "a stiffness", v)), 0);
    o.group("rest", "another group", false, "-rest_on");
    EXPECT_EQ(static_cast<int>(o.real("length", "mm", Range::any(), "a length", v)), 0);
    return error_of([&] { return o.check_unknown(); });
  };
  EXPECT_EQ(check("-test_stiffness 2 -snes_rtol 1e-3 -testing 3 -foo"), ""); // PETSc's names are not pulmo's business
  const std::string text = check("-test_stifness 2");
  EXPECT_HAS(text, "unknown option -test_stifness");
  EXPECT_HAS(text, "did you mean -test_stiffness?");
  EXPECT_HAS(check("-test 2"), "unknown option -test");
  EXPECT_EQ(check("-test_wxyzvut 1").find("did you mean"), std::string::npos);
  EXPECT_HAS(check("-rest_length 2"), "option -rest_length has no effect in this scene: it needs -rest_on");
}

/// Error of setting up a scene on the small cube.
std::string scene_error(const std::string &options)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  return error_of([&] {
    return prepare(run,
                   "-dm_plex_filename " + source("meshes/cube_coarse.msh") + " -mesh_scale 1 -pc_type lu " + options);
  });
}

TEST(SceneOptions, AliasesChooseTheSameLaws)
{
  const Registry registry = Registry::standard();
  for (const auto &law : registry.make_tissue_laws())
    for (const std::string given : {law->alias(), law->name()}) {
      if (given.empty()) continue; // not every law has an alias
      SceneRun run(registry);
      PULMO_OK(set_options("-tissue " + given));
      PULMO_OK(run.declare());
      EXPECT_STREQ(run.scene().tissue().law().name(), law->name());
    }
  EXPECT_HAS(scene_error("-tissue cm0"), "knows no 'cm0'");
}

TEST(SceneOptions, ParametersReachTheLaw)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(set_options("-tissue cm4 -tissue_c 2.5 -tissue_beta 0.5"));
  PULMO_OK(run.declare());
  const PointState s = state_of_F(1.1 * identity);
  const double J = 1.331;
  EXPECT_NEAR(run.scene().tissue().law().energy(s), 2.5 * 3 * 0.21 + 2.5 / 0.5 * (1 / J - 1), 1e-14);
}

TEST(SceneOptions, ParametersOfAnotherLawAreErrors)
{
  const std::string text = scene_error("-tissue birzle -tissue_c_q 3");
  EXPECT_HAS(text, "-tissue_c_q");
  EXPECT_HAS(text, "-tissue rausch");
  // shared by several laws: fine for each of them, and for no other
  EXPECT_EQ(scene_error("-tissue cm4 -tissue_c 1"), "");
  EXPECT_EQ(scene_error("-tissue cm2 -tissue_c 1"), "");
  EXPECT_HAS(scene_error("-tissue cm1 -tissue_c 1"), "-tissue_c has no effect");
}

TEST(SceneOptions, OptionsOfInactiveEffectsAreErrors)
{
  const std::pair<const char *, const char *> cases[] = {{"-chest_wall_stiffness 0.1", "-chest_wall"},
                                                         {"-airflow_permeability 10", "-airflow"},
                                                         {"-ventilator_pip 6", "-ventilator"},
                                                         {"-support_rigid", "-support"},
                                                         {"-traction_value 1,0,0", "-traction"}};
  for (const auto &[given, cure] : cases) {
    const std::string text = scene_error(given);
    EXPECT_HAS(text, "has no effect in this scene");
    EXPECT_HAS(text, std::string("needs ") + cure);
  }
  EXPECT_EQ(scene_error("-chest_wall off -airflow off -ventilator off"), "");
}

TEST(SceneOptions, SettingsOfAnEffectThatIsTurnedOffAreKept)
{
  EXPECT_EQ(scene_error("-chest_wall off -chest_wall_direction full"), "");
  EXPECT_EQ(scene_error("-airflow -airflow_surfaces x1 -airflow_permeability 3 -airflow off"), "");
  EXPECT_EQ(scene_error("-chest_wall -chest_wall_surfaces x0,z1 -chest_wall_stiffness_z1 0.2 -chest_wall off"), "");
  EXPECT_EQ(scene_error("-ventilator pcv -ventilator_pip 9 -ventilator off"), "");
  EXPECT_HAS(scene_error("-chest_wall_direction full -chest_wall off -chest_wall on -chest_wall_surfaces q"),
             "has no surface");
  EXPECT_HAS(scene_error("-chest_wall off -chest_wall_stiffnes 1"), "unknown option -chest_wall_stiffnes");
}

TEST(SceneOptions, MistakesNameTheMend)
{
  EXPECT_HAS(scene_error("-chest_wall -chest_wall_surfaces x9"), "it has x0, x1, y0, y1, z0, z1");
  EXPECT_HAS(scene_error("-chest_wall -chest_wall_surfaces x0 -chest_wall_stiffness -1"), ">= 0");
  EXPECT_HAS(scene_error("-chest_wall -chest_wall_surfaces x0 -chest_wall_stiffnes 1"),
             "did you mean -chest_wall_stiffness?");
  EXPECT_HAS(scene_error("-chest_wall -chest_wall_surfaces x0 -chest_wall_direction sideways"), "full, normal");
  EXPECT_HAS(scene_error("-lumen_pressure -lumen_pressure_surfaces x0"), "needs a gas pressure");
  EXPECT_HAS(scene_error("-lumen_pressure_surfaces x0"), "needs a gas pressure");
  EXPECT_HAS(scene_error("-support"), "-support_surfaces");
  EXPECT_HAS(scene_error("-support -support_surfaces x0 -support_components_x0 xw"), "letters x, y and z");
  EXPECT_HAS(scene_error("-traction"), "-traction_surfaces");
  EXPECT_HAS(scene_error("-tissue birzle -tissue_d1 2.5"), "whole number");
  EXPECT_HAS(scene_error("-tissue berger -tissue_phi0 1.2"), "out of range");
  EXPECT_EQ(scene_error("-tissue berger -tissue_phi0 1"), "");
  EXPECT_HAS(scene_error("-ventilator pcv -ventilator_ramp 2"), "shorten the ramp");
  EXPECT_HAS(scene_error("-ventilator pcv -ventilator_pip 3 -ventilator_peep 5"), "raise pip or lower peep");
  EXPECT_HAS(scene_error("-ventilator pcv -ventilator_breaths 0"), "out of range");
  EXPECT_HAS(scene_error("-airflow -airflow_surfaces x1 -airflow_permeability 0"), "> 0");
  EXPECT_HAS(scene_error("-airflow -airflow_surfaces x1 -tissue_porosity 1"), "0 < value < 1");
  EXPECT_HAS(scene_error("-quadrature_degree 9"), "out of range");
}

TEST(SceneOptions, SurfacesHaveStiffnessesOfTheirOwn)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(
      prepare(run, "-dm_plex_filename " + source("meshes/cube_coarse.msh") +
                       " -mesh_scale 1 -pc_type lu -chest_wall -chest_wall_surfaces y0,z1,x1 -chest_wall_stiffness 0.5"
                       " -chest_wall_stiffness_z1 0.25"));
  for (const ParameterBlock &block : run.model().composition().parameter_blocks()) {
    if (block.owner != std::string("chest_wall")) continue;
    EXPECT_EQ(block.data[0], 0.5);
    EXPECT_EQ(block.data[1], 0.25);
    EXPECT_EQ(block.data[2], 0.5);
    return;
  }
  FAIL() << "no parameters of the chest wall";
}

TEST(SceneOptions, WhatPetscRenamedGoesByBothNames)
{
  const std::string scene =
      "-dm_plex_filename " + source("meshes/cube_coarse.msh") + " -mesh_scale 1 -pc_type lu -support -support_rigid";
  const char *const later[] = {" -ts_time_step 0.0125", " -snes_linesearch_maxlambda 0.5",
                               " -snes_linesearch_type secant"};
  const char *const earlier[] = {" -ts_dt 0.0125", " -snes_linesearch_maxstep 0.5", " -snes_linesearch_type l2"};
  for (const auto &names : {later, earlier}) {
    pulmo::Run run(Registry::standard());
    PULMO_OK(prepare(run, scene + names[0] + names[1] + names[2]));
    EXPECT_EQ(run.simulation().wanted_dt(), 0.0125) << names[0];
    std::vector<std::pair<std::string, std::string>> list;
    PULMO_OK(run.options().all_given(list));
    std::map<std::string, std::string> given(list.begin(), list.end());
    EXPECT_EQ(given["-ts_dt"], "0.0125");
    EXPECT_EQ(given["-snes_linesearch_maxstep"], "0.5");
    EXPECT_EQ(given["-snes_linesearch_type"], "l2");
    // and this PETSc took them: its own names are those that petsc.hpp gives for it
    SNES snes;
    SNESLineSearch search;
    SNESLineSearchType type;
    PetscReal longest;
    PULMO_OK(TSGetSNES(run.simulation().ts(), &snes));
    PULMO_OK(SNESGetLineSearch(snes, &search));
    PULMO_OK(SNESLineSearchGetType(search, &type));
    PULMO_OK(SNESLineSearchGetTolerances(search, nullptr, &longest, nullptr, nullptr, nullptr, nullptr));
    EXPECT_STREQ(type, compat::renamed_line_search.later_here ? "secant" : "l2");
    EXPECT_EQ(longest, 0.5);
  }
  pulmo::Run run(Registry::standard());
  const std::string text = error_of([&] { return prepare(run, scene + " -ts_dt 0.1 -ts_time_step 0.2"); });
  EXPECT_HAS(text, "options -ts_dt and -ts_time_step are two names of the same");
  for (const char *name : {"-ts_max_reject", "-ts_max_step_rejections"}) { // refused by the name that was given
    pulmo::Run another(Registry::standard());
    EXPECT_HAS(error_of([&] { return prepare(another, scene + " " + name + " 3"); }), std::string("option ") + name);
  }
}

TEST(SceneOptions, TheListOfGivenOptionsKeepsBlanksAndDashes)
{
  PULMO_OK(PetscOptionsClear(nullptr));
  PULMO_OK(PetscOptionsSetValue(nullptr, "-output_dir", "pcv -peep 5"));
  PULMO_OK(PetscOptionsSetValue(nullptr, "-peep", "a"));
  PULMO_OK(PetscOptionsSetValue(nullptr, "-flag", nullptr));
  PetscBool used; // values of what was read, and of what was not
  PULMO_OK(PetscOptionsHasName(nullptr, nullptr, "-output_dir", &used));
  for (int again = 0; again < 2; ++again) {
    OptionList list;
    PULMO_OK(Options(PETSC_COMM_WORLD).all_given(list));
    const std::map<std::string, std::string> given(list.begin(), list.end());
    const std::map<std::string, std::string> expected{{"-output_dir", "pcv -peep 5"}, {"-peep", "a"}, {"-flag", ""}};
    EXPECT_EQ(given, expected);
  }
  PULMO_OK(PetscOptionsUsed(nullptr, "-flag", &used));
  EXPECT_FALSE(used) << "the list reads nothing";
}

TEST(SceneOptions, HintsNameOptionsThatServe)
{
  const std::string bare = scene_error("-ventilator_pipp 4");
  EXPECT_HAS(bare, "did you mean -ventilator_pip, which needs -ventilator pcv?");
  EXPECT_HAS(scene_error("-ventilator pcv -ventilator_pipp 4"), "did you mean -ventilator_pip?");
  const std::string dashes = scene_error("--lemon 3");
  EXPECT_HAS(dashes, "options begin with one dash");
  EXPECT_EQ(dashes.find("did you mean"), std::string::npos) << dashes;
  EXPECT_HAS(scene_error("--tissue birzle"), "did you mean -tissue?");
  EXPECT_HAS(scene_error("-TS_dt 0.1"), "in small letters, -ts_dt");
}

TEST(SceneOptions, TheListOfGivenOptionsKeepsNegativeNumbers)
{
  std::vector<std::pair<std::string, std::string>> list;
  Options options(PETSC_COMM_WORLD);
  PULMO_OK(set_options("-a -1.5 -b -c -2e-3,4,-1 -d text"));
  PULMO_OK(options.all_given(list));
  std::map<std::string, std::string> given(list.begin(), list.end());
  EXPECT_EQ(given.size(), 4u);
  EXPECT_EQ(given["-a"], "-1.5");
  EXPECT_EQ(given["-b"], "");
  EXPECT_EQ(given["-c"], "-2e-3,4,-1");
  EXPECT_EQ(given["-d"], "text");
}

} // namespace
} // namespace pulmo::test
