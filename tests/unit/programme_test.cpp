// The ventilator's phases: from the options of each mode, and from files.
#include "unit/scenes.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/physics/effects/ventilator.hpp"

#include <fstream>
#include <random>
#include <unistd.h>

namespace pulmo::test {
namespace {

constexpr double k = 0.0980665; // kPa per cmH2O

/// A phase of the internal units.
Phase phase(Control control, double begin, double end, double from, double to, double ramp)
{
  Phase p;
  p.name = "phase";
  p.control = control;
  p.begin = begin;
  p.end = end;
  p.from = from;
  p.to = to;
  p.ramp = ramp;
  return p;
}

TEST(Phase, RampsAndPlateaus)
{
  const Phase ramped = phase(Control::pressure, 2, 3, 0.1, 0.6, 0.25);
  EXPECT_DOUBLE_EQ(ramped.value(2.0), 0.1);
  EXPECT_DOUBLE_EQ(ramped.value(2.125), 0.35);
  EXPECT_DOUBLE_EQ(ramped.value(2.25), 0.6);
  EXPECT_DOUBLE_EQ(ramped.value(3.0), 0.6);
  EXPECT_DOUBLE_EQ(phase(Control::pressure, 3, 5, 0.6, 0.1, 0).value(3 + 1e-9), 0.1);
}

TEST(Phase, DeliversTheIntegralOfItsFlow)
{
  const Phase p = phase(Control::flow, 1, 3, 800, 200, 1.5);
  double sum = 0; // midpoint rule: exact on both linear pieces
  const int n = 2000;
  for (int i = 0; i < n; ++i) {
    EXPECT_NEAR(p.delivered(1 + 2.0 * i / n), sum, 1e-9);
    sum += p.value(1 + 2.0 * (i + 0.5) / n) * 2 / n;
  }
  EXPECT_NEAR(p.delivered(3), 1.5 * 500 + 0.5 * 200, 1e-12);
  EXPECT_NEAR(phase(Control::flow, 0, 1, 0, 500, 0).delivered(0.3), 150, 1e-12);
}

/// The phases of ventilator options.
std::vector<Phase> phases_of(const std::string &given)
{
  Ventilator ventilator;
  Options options(PETSC_COMM_WORLD);
  EXPECT_EQ(static_cast<int>(set_options("-ventilator " + given)), 0);
  EXPECT_EQ(static_cast<int>(ventilator.declare(options)), 0);
  return ventilator.programme().phases();
}

/// Phases follow one another without gaps, and a ramp starts where the phase before ended.
void expect_chain(const std::vector<Phase> &phases)
{
  double t = 0;
  for (std::size_t i = 0; i < phases.size(); ++i) {
    EXPECT_DOUBLE_EQ(phases[i].begin, t);
    t = phases[i].end;
    if (i > 0 && phases[i].control == phases[i - 1].control) {
      ASSERT_TRUE(phases[i].from.has_value());
      EXPECT_DOUBLE_EQ(*phases[i].from, phases[i - 1].to) << "a jump into " << phases[i].name;
    }
  }
}

TEST(Ventilator, DefaultsOfPressureControl)
{
  const auto p = phases_of("pcv");
  ASSERT_EQ(p.size(), 2u);
  expect_chain(p);
  EXPECT_EQ(p[0].name, "inspiration");
  EXPECT_EQ(p[1].name, "expiration");
  EXPECT_DOUBLE_EQ(p[1].end, 3);
  EXPECT_DOUBLE_EQ(p[0].value(0.05), 3 * k);
  EXPECT_DOUBLE_EQ(p[0].value(0.1), 6 * k);
  EXPECT_DOUBLE_EQ(p[0].value(1), 6 * k);
  EXPECT_DOUBLE_EQ(p[1].value(1.0001), 0);
}

TEST(Ventilator, PeepSettlesFirstAndBreathsFollow)
{
  const auto p = phases_of("pcv -ventilator_pip 15 -ventilator_peep 5 -ventilator_pause 0.4 -ventilator_breaths 3"
                           " -ventilator_inspiration 0.8 -ventilator_expiration 1.6 -ventilator_ramp 0.2"
                           " -ventilator_ramp_down 0.3");
  const char *names[] = {"settle", "inspiration", "pause",       "expiration", "inspiration",
                         "pause",  "expiration",  "inspiration", "pause",      "expiration"};
  ASSERT_EQ(p.size(), 10u);
  expect_chain(p);
  for (std::size_t i = 0; i < 10; ++i) {
    EXPECT_EQ(p[i].name, names[i]);
    EXPECT_EQ(p[i].breath, i == 0 ? 0 : static_cast<PetscInt>((i + 2) / 3));
  }
  EXPECT_NEAR(p.back().end, 0.2 + 1.6 + 3 * 2.8, 1e-12);
  EXPECT_DOUBLE_EQ(p[0].end, 1.8); // ramp and one expiration
  EXPECT_NEAR(p[0].value(0.1), 2.5 * k, 1e-14);
  EXPECT_NEAR(p[0].value(1.8), 5 * k, 1e-14);
  EXPECT_NEAR(p[1].value(1.9), 10 * k, 1e-14);
  EXPECT_NEAR(p[2].value(2.8), 15 * k, 1e-14);
  EXPECT_NEAR(p[3].value(3.15), 10 * k, 1e-12);
  EXPECT_NEAR(p[9].value(p[9].end), 5 * k, 1e-14);
}

TEST(Ventilator, VolumeControlDeliversTheTidalVolume)
{
  for (const char *ramp : {"0", "0.3"}) {
    const auto p = phases_of(std::string("vcv -ventilator_tidal_volume 420 -ventilator_peep 4 -ventilator_breaths 2"
                                         " -ventilator_ramp_down 0.2 -ventilator_ramp ") +
                             ramp);
    ASSERT_EQ(p.size(), 7u);
    EXPECT_EQ(p[1].control, Control::flow);
    EXPECT_EQ(*p[1].from, 0);
    EXPECT_NEAR(p[1].delivered(p[1].end), 420e3, 1e-6);
    EXPECT_EQ(p[2].name, "pause");
    EXPECT_EQ(p[2].control, Control::flow);
    EXPECT_EQ(p[2].value(p[2].end), 0);
    EXPECT_NEAR(p[2].end - p[2].begin, 0.25, 1e-12);
    EXPECT_EQ(p[3].control, Control::pressure);
    EXPECT_FALSE(p[3].from.has_value()) << "known only once the pause has run";
    EXPECT_NEAR(p[3].to, 4 * k, 1e-15);
  }
}

TEST(Ventilator, SupersyringeGoesUpAndDown)
{
  const auto p = phases_of("supersyringe");
  ASSERT_EQ(p.size(), 32u); // 8 up, 8 down, each with a pause
  expect_chain(p);
  double volume = 0, top = 0;
  for (const Phase &phase : p) {
    EXPECT_EQ(phase.breath, 1);
    volume += phase.delivered(phase.end);
    top = std::max(top, volume);
  }
  EXPECT_NEAR(top, 800e3, 1e-6);
  EXPECT_NEAR(volume, 0, 1e-6);
  EXPECT_NEAR(p.back().end, 16 * 2.3, 1e-10);
  EXPECT_EQ(p[0].name, "inflation");
  EXPECT_EQ(p[1].name, "pause");
  EXPECT_EQ(p[16].name, "deflation");
}

// ------------------------------------------------------------------------------------------------------------ files

std::vector<Phase> parse(const std::string &text)
{
  std::vector<Phase> phases;
  EXPECT_EQ(static_cast<int>(parse_programme(PETSC_COMM_WORLD, "file", text, phases)), 0) << text;
  return phases;
}

TEST(ProgrammeFile, PhasesRepeatsAndBreaths)
{
  const auto p = parse("# a comment\n"
                       "settle 1 pressure 5 ramp 0.5\n\n"
                       "repeat 2   # breaths\n"
                       "  inspiration 0.8 flow 200 from 800 ramp 0.8 limit 25\n"
                       "  pause 0.2 hold\n"
                       "  repeat 3\n"
                       "    expiration 0.5 pressure 5\n"
                       "  end\n"
                       "end\n"
                       "sigh 2 pressure 30 ramp 1");
  ASSERT_EQ(p.size(), 1u + 2 * 5 + 1);
  EXPECT_EQ(p[0].breath, 0);
  EXPECT_EQ(*p[0].from, 0);
  EXPECT_NEAR(p[0].to, 5 * k, 1e-15);
  EXPECT_EQ(p[1].breath, 1);
  EXPECT_NEAR(p[1].delivered(p[1].end), 400e3, 1e-6);
  EXPECT_NEAR(*p[1].limit, 25 * k, 1e-15);
  EXPECT_EQ(p[2].control, Control::flow);
  EXPECT_EQ(p[2].to, 0);
  EXPECT_EQ(p[6].breath, 2);
  EXPECT_EQ(p[11].name, "sigh");
  EXPECT_NEAR(*p[11].from, 5 * k, 1e-15);
  EXPECT_NEAR(p[11].end, 1 + 2 * 2.5 + 2, 1e-12);
}

TEST(ProgrammeFile, AnyPhaseMayBeginABreathAndHaveItsOwnSteps)
{
  const auto p = parse("rise 1 pressure 5 ramp 1 breath\n"
                       "fall 1 pressure 0 dt 0.02\n"
                       "rise 1 flow 100 dt 0.2 breath limit 9\n"
                       "closed 1 hold dt 0.5\n"
                       "inspiration 1 pressure 5 breath\n"
                       "hold_it 1 hold breath\n");
  const PetscInt breaths[] = {1, 1, 2, 2, 3, 4};
  for (std::size_t i = 0; i < 6; ++i) EXPECT_EQ(p[i].breath, breaths[i]) << i;
  EXPECT_FALSE(p[0].dt);
  EXPECT_DOUBLE_EQ(*p[1].dt, 0.02);
  EXPECT_DOUBLE_EQ(*p[2].dt, 0.2);
  EXPECT_NEAR(*p[2].limit, 9 * k, 1e-15);
  EXPECT_DOUBLE_EQ(*p[3].dt, 0.5);
  EXPECT_EQ(p[3].where, "file:4");
  const Programme programme(p);
  EXPECT_TRUE(programme.breathes());
  EXPECT_DOUBLE_EQ(programme.end_of_breath(2), 4);
  EXPECT_FALSE(Programme(parse("step 1 pressure 5\nstep 1 pressure 0\n")).breathes());
}

/// The ventilator with phases of a file; what it does if a load moves the lung at rest.
SceneFacts facts_of(const std::string &text, const std::string &more = "")
{
  const std::string file = testing::TempDir() + "pulmo_programme_" + std::to_string(getpid()) + ".txt";
  std::ofstream(file) << text;
  Ventilator ventilator;
  Options options(PETSC_COMM_WORLD);
  SceneFacts facts;
  EXPECT_EQ(static_cast<int>(set_options("-ventilator programme -ventilator_programme " + file + " " + more)), 0);
  EXPECT_EQ(static_cast<int>(ventilator.declare(options)), 0);
  EXPECT_EQ(static_cast<int>(ventilator.announce(facts)), 0);
  std::remove(file.c_str());
  return facts;
}

TEST(Settling, ComesBeforeAProgrammeThatBeginsWithABreath)
{
  const char *breath = "inspiration 1 pressure 9 ramp 0.1\nexpiration 2 pressure 0 dt 0.2\n";
  SceneFacts facts = facts_of(breath);
  ASSERT_EQ(facts.ventilator->phases().size(), 2u) << "nothing comes first unless a load asks for it";
  ASSERT_TRUE(facts.settling.programme);
  const auto &p = facts.settling.programme->phases();
  ASSERT_EQ(p.size(), 3u);
  expect_chain(p);
  EXPECT_EQ(p[0].name, "settle");
  EXPECT_EQ(p[0].breath, 0);
  EXPECT_DOUBLE_EQ(p[0].end, 2);
  EXPECT_EQ(p[0].to, 0);
  EXPECT_EQ(p[1].breath, 1);
  EXPECT_DOUBLE_EQ(p[1].end, 3);
  EXPECT_DOUBLE_EQ(*p[2].dt, 0.2);
  EXPECT_DOUBLE_EQ(p[2].end, 5);

  EXPECT_DOUBLE_EQ(facts_of(breath, "-ventilator_settle_duration 7").settling.programme->phases()[0].end, 7);
  EXPECT_DOUBLE_EQ(*facts_of(breath, "-ventilator_dt_scale 4").ventilator->phases()[1].dt, 0.8);
  facts = facts_of(breath, "-ventilator_settle off");
  EXPECT_TRUE(facts.settling.off);
  EXPECT_FALSE(facts.settling.programme);
  EXPECT_EQ(facts.ventilator->phases().size(), 2u);
  facts = facts_of(breath, "-ventilator_settle on");
  EXPECT_FALSE(facts.settling.programme);
  EXPECT_EQ(facts.ventilator->phases()[0].name, "settle");
  // phases before the first breath are a settling of the user's own
  EXPECT_FALSE(facts_of(std::string("wait 1 pressure 0\n") + breath).settling.programme);
  EXPECT_FALSE(facts_of("step 1 pressure 5\n").settling.programme);
  // an airway that begins with a pressure inflates the lung at rest, as PEEP does
  facts = facts_of("inspiration 1 pressure 9 from 5 ramp 0.1\nexpiration 2 pressure 5\n");
  ASSERT_EQ(facts.ventilator->phases().size(), 3u);
  EXPECT_NEAR(facts.ventilator->phases()[0].to, 5 * k, 1e-15);
}

TEST(Settling, OfTheOtherModes)
{
  for (const char *mode : {"pcv", "vcv -ventilator_ramp 0.1", "supersyringe"}) {
    Ventilator ventilator;
    Options options(PETSC_COMM_WORLD);
    SceneFacts facts;
    EXPECT_EQ(static_cast<int>(set_options(std::string("-ventilator ") + mode)), 0);
    EXPECT_EQ(static_cast<int>(ventilator.declare(options)), 0);
    EXPECT_EQ(static_cast<int>(ventilator.announce(facts)), 0);
    EXPECT_EQ(facts.ventilator->phases()[0].breath, 1) << mode;
    ASSERT_TRUE(facts.settling.programme) << mode;
    const auto &p = facts.settling.programme->phases();
    expect_chain(p);
    EXPECT_EQ(p.size(), facts.ventilator->phases().size() + 1) << mode;
    EXPECT_EQ(p[0].name, "settle") << mode;
    EXPECT_NEAR(p[0].end, std::string(mode) == "supersyringe" ? 2 : 2.1, 1e-12) << mode;
  }
  EXPECT_EQ(phases_of("pcv -ventilator_peep 5 -ventilator_pip 15")[0].name, "settle");
  EXPECT_EQ(phases_of("pcv -ventilator_peep 5 -ventilator_pip 15 -ventilator_settle off")[0].name, "settle");
  EXPECT_DOUBLE_EQ(phases_of("pcv -ventilator_peep 5 -ventilator_pip 15 -ventilator_settle_duration 9")[0].end, 9);
  EXPECT_EQ(phases_of("vcv -ventilator_settle on")[0].name, "settle");
}

/// What the reader says of a file that it refuses.
std::string complaint(const std::string &text)
{
  std::vector<Phase> phases;
  testing::internal::CaptureStderr();
  const auto code = parse_programme(PETSC_COMM_WORLD, "file", text, phases);
  const std::string said = testing::internal::GetCapturedStderr();
  EXPECT_EQ(static_cast<int>(code), static_cast<int>(PETSC_ERR_USER_INPUT)) << text;
  return said;
}

TEST(ProgrammeFile, ErrorsNameFileLineAndMend)
{
  const std::pair<const char *, const char *> wrong[] = {
      {"", "file holds no phase"},
      {"# only a comment\n", "file holds no phase"},
      {"inspiration\n", "file:1: phase 'inspiration' needs a duration"},
      {"\n\ninspiration one pressure 5\n", "file:3: the duration (s) must be a number, not 'one'"},
      {"inspiration 0 pressure 5\n", "file:1: the duration 0 s of phase 'inspiration' must be positive"},
      {"inspiration -1 pressure 5\n", "must be positive"},
      {"inspiration nan pressure 5\n", "must be a number"},
      {"inspiration 1 presure 5\n", "'presure' is no kind of phase; write pressure, flow or hold"},
      {"inspiration 1 pressure\n", "'pressure' needs a value in cmH2O"},
      {"inspiration 1 flow\n", "'flow' needs a value in ml/s"},
      {"inspiration 1 pressure 5cm\n", "must be a number, not '5cm'"},
      {"inspiration 1 pressure 5 ramp\n", "'ramp' needs a number"},
      {"inspiration 1 pressure 5 ramp 2\n", "must lie between 0 and the duration"},
      {"inspiration 1 pressure 5 from 2\n", "'from' is the start of a ramp"},
      {"inspiration 1 pressure 5 limit 20\n", "'limit' does not belong to a pressure phase"},
      {"pause 1 hold 5\n", "'5' does not belong to a hold phase; it may have 'trigger', 'dt' and 'breath'"},
      {"pause 1 hold ramp 0.5\n", "'ramp' does not belong to a hold phase"},
      {"inspiration 1 pressure 5 breath breath\n", "'breath' is given twice"},
      {"inspiration 1 pressure 5 dt\n", "'dt' needs a number"},
      {"inspiration 1 pressure 5 dt 0\n", "file:1: 'dt' must be positive, at least 1e-06 s"},
      {"inspiration 1 pressure 5 dt 0.1 dt 0.1\n", "'dt' is given twice"},
      {"inspiration 1 pressure 5 ramp 0.1 ramp 0.5\n", "'ramp' is given twice"},
      {"inspiration 0x1 pressure 5\n", "must be a number, not '0x1'"},
      {"inspiration 1e-15 pressure 5\n", "must be positive, at least"},
      {"repeat 2\na 1 hold\n", "file:1: this 'repeat' has no 'end'"},
      {"a 1 hold\nend\n", "file:2: 'end' closes no 'repeat'"},
      {"repeat 2\nend\n", "file:1: 'repeat' repeats nothing"},
      {"repeat 1.5\na 1 hold\nend\n", "must be a whole number"},
      {"repeat\na 1 hold\nend\n", "'repeat' takes one whole number"},
      {"repeat 2\na 1 hold\nend 3\n", "file:3: 'end' stands alone"},
      {"repeat 10000\nrepeat 10000\na 1 hold\nend\nend\n", "file:3: more than 1000000 phases"},
      {"\x7f\x45\x4c\x46\x02\x01 1 hold\n", "line 1 holds bytes that are no text"},
  };
  for (const auto &[text, what] : wrong) {
    const std::string said = complaint(text);
    EXPECT_NE(said.find(what), std::string::npos) << "'" << text << "' gave: " << said;
  }
}

TEST(ProgrammeFile, AByteOrderMarkIsSkipped)
{
  EXPECT_EQ(parse("\xEF\xBB\xBFpause 1 hold\n")[0].name, "pause");
}

TEST(ProgrammeFile, RandomTextIsReadOrRefused)
{
  const char *words[] = {"repeat", "end",  "inspiration", "1",     "0.5", "-3",  "pressure", "flow",
                         "hold",   "ramp", "from",        "limit", "#",   "1e9", "\n",       "x y"};
  std::mt19937 random(7);
  int read = 0, refused = 0;
  for (int i = 0; i < 3000; ++i) {
    std::string text;
    for (unsigned n = random() % 12; n > 0; --n)
      text += std::string(words[random() % 16]) + (random() % 3 ? " " : "\n");
    std::vector<Phase> phases;
    testing::internal::CaptureStderr();
    const auto code = static_cast<int>(parse_programme(PETSC_COMM_WORLD, "file", text, phases));
    (void)testing::internal::GetCapturedStderr();
    ASSERT_TRUE(code == 0 || code == static_cast<int>(PETSC_ERR_USER_INPUT)) << text;
    ++(code ? refused : read);
    if (code == 0) {
      expect_chain(phases);
    }
  }
  EXPECT_GT(read, 0);
  EXPECT_GT(refused, 0);
}

} // namespace
} // namespace pulmo::test
