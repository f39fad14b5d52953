#include "pulmo/input/programme.hpp"

#include "pulmo/base/text_file.hpp"
#include "pulmo/base/units.hpp"
#include "pulmo/input/user_file.hpp"

#include <algorithm>
#include <cmath>
#include <sstream>

namespace pulmo {

namespace {

/// More phases than this in a file are a slip (a repeat count with a digit too many).
constexpr std::size_t max_phases = 1000000;
/// Shorter phases would be lost in the rounding of the clock, s.
constexpr PetscReal least_duration = 1e-6;
/// So would least_duration in a run that lasts longer, s.
constexpr PetscReal longest_run = 1e7;
/// No lung bears more, cmH2O or ml/s.
constexpr PetscReal largest_value = 1e9;
/// Repeats within repeats.
constexpr int deepest_repeat = 100;
/// Larger files are no programme, bytes.
constexpr long largest_file = 16L << 20;

PetscReal internal(Control control, PetscReal value)
{
  return value * (control == Control::pressure ? units::kPa_per_cmH2O : units::mm3_per_ml);
}

} // namespace

PetscReal Phase::value(PetscReal t) const
{
  const PetscReal since = std::max<PetscReal>(t - begin, 0);
  return ramp > 0 && since < ramp ? *from + (to - *from) * since / ramp : to;
}

PetscReal Phase::delivered(PetscReal t) const
{
  const PetscReal since = t - begin, rising = std::min(since, ramp);
  PetscReal volume = to * (since - rising);
  if (ramp > 0) volume += rising * (*from + (to - *from) * rising / (2 * ramp));
  return volume;
}

bool Programme::prescribes_flow() const
{
  return std::any_of(phases_.begin(), phases_.end(), [](const Phase &p) { return p.control == Control::flow; });
}

bool Programme::prescribes_pressure() const
{
  return std::any_of(phases_.begin(), phases_.end(), [](const Phase &p) { return p.control == Control::pressure; });
}

bool Programme::limits_pressure() const
{
  return std::any_of(phases_.begin(), phases_.end(), [](const Phase &p) { return p.limit.has_value(); });
}

bool Programme::may_end_early() const
{
  return std::any_of(phases_.begin(), phases_.end(), [](const Phase &p) { return p.may_end_early(); });
}

bool Programme::breathes() const
{
  return std::any_of(phases_.begin(), phases_.end(), [](const Phase &p) { return p.breath > 0; });
}

PetscReal Programme::end_of_breath(PetscInt breath) const
{
  const auto last = std::find_if(phases_.rbegin(), phases_.rend(), [&](const Phase &p) { return p.breath == breath; });
  return last == phases_.rend() ? 0 : last->end;
}

void ProgrammeBuilder::append(Phase phase)
{
  const PetscReal duration = phase.end - phase.begin;
  phase.begin = phases_.empty() ? 0 : phases_.back().end;
  phase.end = phase.begin + duration;
  phases_.push_back(std::move(phase));
}

Phase &ProgrammeBuilder::add(const std::string &name, PetscInt breath, PetscReal duration, Control control,
                             PetscReal value, PetscReal ramp, std::optional<PetscReal> from)
{
  Phase phase;
  phase.name = name;
  phase.breath = breath;
  phase.begin = phases_.empty() ? 0 : phases_.back().end;
  phase.end = phase.begin + duration;
  phase.control = control;
  phase.to = internal(control, value);
  phase.ramp = ramp;
  if (from)
    phase.from = internal(control, *from);
  else if (phases_.empty())
    phase.from = 0;
  else if (phases_.back().control == control)
    phase.from = phases_.back().to;
  else if (control == Control::flow)
    phase.from = 0;
  phases_.push_back(phase);
  return phases_.back();
}

namespace {

/// A line of a programme file, cut into words.
struct Line {
  int number;
  std::vector<std::string> words;
};

/// Lines of a clean text without comments and blanks.
std::vector<Line> cut(const std::string &text)
{
  std::vector<Line> lines;
  int number = 0;
  for (const std::string &raw : lines_of(text)) {
    std::istringstream words(raw.substr(0, raw.find('#')));
    Line line{++number, {}};
    for (std::string word; words >> word;) line.words.push_back(word);
    if (!line.words.empty()) lines.push_back(line);
  }
  return lines;
}

/// Turns the lines of a file into phases.
class Parser {
public:
  Parser(MPI_Comm comm, const std::string &file, const std::string &text) : comm_(comm), file_(file), lines_(cut(text))
  {}

  PetscErrorCode parse(std::vector<Phase> &phases)
  {
    PetscFunctionBeginUser;
    PetscCall(block(0, lines_.size(), -1));
    phases = builder_.take();
    PulmoUserCheck(!phases.empty(), comm_,
                   "%s holds no phase; write lines such as 'inspiration 1.0 pressure 15 ramp 0.1'", file_.c_str());
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  /// Lines [begin, end), the body of the repeat at line number @p opened (-1: the whole file).
  PetscErrorCode block(std::size_t begin, std::size_t end, int opened)
  {
    PetscFunctionBeginUser;
    for (std::size_t i = begin; i < end; ++i) {
      const Line &line = lines_[i];
      if (line.words[0] == "repeat") {
        std::size_t close = i;
        long times = 0;
        PulmoUserCheck(++depth_ <= deepest_repeat, comm_,
                       "%s:%d: more than %d 'repeat' within one another; write fewer", file_.c_str(), line.number,
                       deepest_repeat);
        PetscCall(repeat(i, end, close, times));
        for (long k = 0; k < times; ++k) PetscCall(block(i + 1, close, line.number));
        i = close;
        --depth_;
      } else {
        PulmoUserCheck(line.words[0] != "end", comm_, "%s:%d: 'end' closes no 'repeat'; remove it", file_.c_str(),
                       line.number);
        PetscCall(phase(line));
      }
    }
    PulmoUserCheck(opened < 0 || begin < end, comm_, "%s:%d: 'repeat' repeats nothing; write phases before its 'end'",
                   file_.c_str(), opened);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// The repeat at line @p i: how often, and which line closes it.
  PetscErrorCode repeat(std::size_t i, std::size_t end, std::size_t &close, long &times)
  {
    const Line &line = lines_[i];
    PetscReal count = 0;
    int depth = 0;

    PetscFunctionBeginUser;
    PulmoUserCheck(line.words.size() == 2, comm_, "%s:%d: 'repeat' takes one whole number, e.g. 'repeat 3'",
                   file_.c_str(), line.number);
    PetscCall(number(line, 1, "the count of 'repeat'", count));
    PulmoUserCheck(count >= 1 && count <= (PetscReal)max_phases && count == std::floor(count), comm_,
                   "%s:%d: 'repeat %s' must be a whole number of at least 1", file_.c_str(), line.number,
                   line.words[1].c_str());
    times = static_cast<long>(count);
    for (close = i + 1; close < end; ++close) {
      const std::string &word = lines_[close].words[0];
      if (word == "repeat") ++depth;
      if (word == "end" && depth-- == 0) break;
    }
    PulmoUserCheck(close < end, comm_, "%s:%d: this 'repeat' has no 'end'; close it", file_.c_str(), line.number);
    PulmoUserCheck(lines_[close].words.size() == 1, comm_, "%s:%d: 'end' stands alone on its line", file_.c_str(),
                   lines_[close].number);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// A phase: NAME DURATION pressure|flow VALUE or NAME DURATION hold, and words of words().
  PetscErrorCode phase(const Line &line)
  {
    const auto &w = line.words;
    PetscReal duration, value = 0;
    Words more;

    PetscFunctionBeginUser;
    PulmoUserCheck(std::all_of(w[0].begin(), w[0].end(),
                               [](unsigned char c) { return c < 128 && (std::isalnum(c) || c == '_' || c == '-'); }),
                   comm_, "%s:%d: a line starts with the phase's name, made of letters, digits, '_' and '-'",
                   file_.c_str(), line.number);
    PulmoUserCheck(w.size() >= 3, comm_, "%s:%d: phase '%s' needs a duration in s and pressure, flow or hold",
                   file_.c_str(), line.number, w[0].c_str());
    PetscCall(number(line, 1, "the duration (s)", duration));
    PulmoUserCheck(duration >= least_duration, comm_,
                   "%s:%d: the duration %s s of phase '%s' must be positive, at least %g s", file_.c_str(), line.number,
                   w[1].c_str(), w[0].c_str(), (double)least_duration);
    const bool hold = w[2] == "hold";
    PulmoUserCheck(hold || w[2] == "pressure" || w[2] == "flow", comm_,
                   "%s:%d: '%s' is no kind of phase; write pressure, flow or hold", file_.c_str(), line.number,
                   w[2].c_str());
    const Control control = w[2] == "pressure" ? Control::pressure : Control::flow;
    if (!hold) {
      PulmoUserCheck(w.size() >= 4, comm_, "%s:%d: '%s' needs a value in %s", file_.c_str(), line.number, w[2].c_str(),
                     control == Control::pressure ? "cmH2O" : "ml/s");
      PetscCall(number(line, 3, control == Control::pressure ? "the pressure (cmH2O)" : "the flow (ml/s)", value));
    }
    PetscCall(words(line, hold ? 3 : 4, more));
    const PetscReal ramp = more.ramp.value_or(0);
    PulmoUserCheck(ramp >= 0 && ramp <= duration, comm_,
                   "%s:%d: the ramp %g s must lie between 0 and the duration %g s of phase '%s'", file_.c_str(),
                   line.number, (double)ramp, (double)duration, w[0].c_str());
    PulmoUserCheck(!more.from || ramp > 0, comm_, "%s:%d: 'from' is the start of a ramp; give 'ramp' too",
                   file_.c_str(), line.number);
    PulmoUserCheck(!more.dt || *more.dt >= least_duration, comm_, "%s:%d: 'dt' must be positive, at least %g s",
                   file_.c_str(), line.number, (double)least_duration);
    for (const PetscReal x : {value, more.from.value_or(0), more.limit.value_or(0)})
      PulmoUserCheck(std::abs(x) <= largest_value, comm_, "%s:%d: %g is beyond what a ventilator gives; check the unit",
                     file_.c_str(), line.number, (double)x);
    PulmoUserCheck(!more.trigger || *more.trigger > 0, comm_, "%s:%d: 'trigger' must be positive", file_.c_str(),
                   line.number);
    PulmoUserCheck(!more.cycle || (*more.cycle > 0 && *more.cycle < 100), comm_,
                   "%s:%d: 'cycle' is a share of the phase's highest flow, between 0 and 100 %%", file_.c_str(),
                   line.number);
    PulmoUserCheck(!more.trigger || !more.cycle, comm_,
                   "%s:%d: 'trigger' begins a breath and 'cycle' ends its inspiration; a phase has one of them",
                   file_.c_str(), line.number);
    time_ += duration;
    PulmoUserCheck(time_ <= longest_run, comm_, "%s:%d: the phases last longer than %g s; shorten '%s'", file_.c_str(),
                   line.number, (double)longest_run, w[0].c_str());
    if (more.breath || w[0] == "inspiration") ++breath_;
    PulmoUserCheck(++phases_ <= max_phases, comm_, "%s:%d: more than %d phases; check the counts of 'repeat'",
                   file_.c_str(), line.number, (int)max_phases);
    Phase &added = builder_.add(w[0], breath_, duration, control, value, ramp, more.from);
    if (more.limit) added.limit = internal(Control::pressure, *more.limit);
    if (more.trigger && hold) added.trigger_drop = internal(Control::pressure, *more.trigger);
    if (more.trigger && !hold) added.trigger_flow = internal(Control::flow, *more.trigger);
    if (more.cycle) added.cycle = *more.cycle / 100;
    added.dt = more.dt;
    added.where = file_ + ":" + std::to_string(line.number);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// What may follow the value of a phase.
  struct Words {
    std::optional<PetscReal> from, ramp, limit, dt; // cmH2O or ml/s, s, cmH2O, s
    std::optional<PetscReal> trigger, cycle;        // ml/s (hold: cmH2O), %
    bool breath = false;
  };

  /// [ramp SECONDS] [from VALUE] [limit CMH2O] [trigger VALUE] [cycle PERCENT] [dt SECONDS] [breath] from word @p next
  /// on.
  PetscErrorCode words(const Line &line, std::size_t next, Words &given) const
  {
    const auto &w = line.words;
    const bool hold = w[2] == "hold", flow = w[2] == "flow";

    PetscFunctionBeginUser;
    while (next < w.size()) {
      const std::string &key = w[next];
      if (key == "breath") {
        PulmoUserCheck(!given.breath, comm_, "%s:%d: 'breath' is given twice; keep one", file_.c_str(), line.number);
        given.breath = true;
        ++next;
        continue;
      }
      std::optional<PetscReal> *const number_of = key == "dt"                        ? &given.dt
                                                  : key == "ramp" && !hold           ? &given.ramp
                                                  : key == "from" && !hold           ? &given.from
                                                  : key == "limit" && flow           ? &given.limit
                                                  : key == "trigger" && !flow        ? &given.trigger
                                                  : key == "cycle" && !hold && !flow ? &given.cycle
                                                                                     : nullptr;
      PulmoUserCheck(number_of, comm_, "%s:%d: '%s' does not belong to a %s phase; it may have %s", file_.c_str(),
                     line.number, key.c_str(), w[2].c_str(),
                     hold   ? "'trigger', 'dt' and 'breath'"
                     : flow ? "'from', 'ramp', 'limit', 'dt' and 'breath'"
                            : "'from', 'ramp', 'trigger', 'cycle', 'dt' and 'breath'");
      PulmoUserCheck(next + 1 < w.size(), comm_, "%s:%d: '%s' needs a number", file_.c_str(), line.number, key.c_str());
      PetscReal x;
      PetscCall(number(line, next + 1, "'" + key + "'", x));
      PulmoUserCheck(!*number_of, comm_, "%s:%d: '%s' is given twice; keep one", file_.c_str(), line.number,
                     key.c_str());
      *number_of = x;
      next += 2;
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode number(const Line &line, std::size_t word, const std::string &what, PetscReal &value) const
  {
    const std::string &text = line.words[word];
    char *rest = nullptr;

    PetscFunctionBeginUser;
    value = std::strtod(text.c_str(), &rest);
    const bool decimal = text.find_first_not_of("+-.0123456789eE") == std::string::npos;
    PulmoUserCheck(decimal && *rest == '\0' && std::isfinite(value), comm_, "%s:%d: %s must be a number, not '%s'",
                   file_.c_str(), line.number, what.c_str(), text.c_str());
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  MPI_Comm comm_;
  const std::string &file_;
  std::vector<Line> lines_;
  ProgrammeBuilder builder_;
  PetscInt breath_ = 0;
  std::size_t phases_ = 0;
  PetscReal time_ = 0; // s, end of the last phase
  int depth_ = 0;
};

} // namespace

PetscErrorCode parse_programme(MPI_Comm comm, const std::string &file, const std::string &text,
                               std::vector<Phase> &phases)
{
  std::string clean = text;

  PetscFunctionBeginUser;
  const std::string fault = clean_text(clean);
  PulmoUserCheck(fault.empty(), comm, "%s: %s", file.c_str(), fault.c_str());
  PetscCall(Parser(comm, file, clean).parse(phases));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode read_programme(MPI_Comm comm, const std::string &option, const std::string &file,
                              std::vector<Phase> &phases)
{
  std::string text;

  PetscFunctionBeginUser;
  PetscCall(read_user_file(comm, option, file, largest_file, "programme", text));
  PetscCall(parse_programme(comm, file, text, phases));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
