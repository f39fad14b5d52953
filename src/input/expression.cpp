#include "pulmo/input/expression.hpp"

#include <muParser.h>

#include <algorithm>
#include <cctype>
#include <cmath>
#include <cstdlib>
#include <limits>
#include <sstream>

namespace pulmo {

/// One that is evaluated, by muparser.
struct Expression::Formula {
  std::string text;
  mu::Parser parser;
  mu::value_type x = 0, y = 0, z = 0, t = 0; ///< parser refers to them
  bool of_place = false;
  PetscReal time = std::numeric_limits<PetscReal>::quiet_NaN(), value = 0; ///< the last one, of time alone
};

namespace {

/// What is wrong by muparser's error, in words, and the column.
std::string words(const mu::Parser::exception_type &error, const std::string &text, std::size_t &column)
{
  std::string token = error.GetToken();
  while (!token.empty() && std::isspace(static_cast<unsigned char>(token.back()))) token.pop_back();
  const std::string quoted = "'" + token + "'";
  std::size_t place = error.GetPos() < 0 ? 0 : static_cast<std::size_t>(error.GetPos());

  switch (error.GetCode()) {
  case mu::ecUNEXPECTED_OPERATOR: // muparser tells where it ends
    place -= std::min(place, token.size());
    break;
  case mu::ecUNEXPECTED_EOF:
  case mu::ecMISSING_PARENS:
    place = text.size();
    break;
  default:
    break;
  }
  column = std::min(place, text.size()) + 1;
  switch (error.GetCode()) {
  case mu::ecUNASSIGNABLE_TOKEN:
    return token.empty() || !(std::isalpha(static_cast<unsigned char>(token[0])) || token[0] == '_')
               ? quoted + " means nothing"
               : quoted + " is not known; there are x, y, z (mm), t (s), pi, and functions such as sin, exp, sqrt, min";
  case mu::ecUNEXPECTED_EOF:
    return "it ends where more must follow";
  case mu::ecEMPTY_EXPRESSION:
    return "it is empty";
  case mu::ecMISSING_PARENS:
    return "a parenthesis is not closed";
  case mu::ecTOO_MANY_PARAMS:
    return "too many arguments for " + quoted;
  case mu::ecTOO_FEW_PARAMS:
    return "too few arguments for " + quoted;
  case mu::ecUNEXPECTED_OPERATOR:
  case mu::ecUNEXPECTED_ARG_SEP:
  case mu::ecUNEXPECTED_ARG:
  case mu::ecUNEXPECTED_VAL:
  case mu::ecUNEXPECTED_VAR:
  case mu::ecUNEXPECTED_PARENS:
  case mu::ecUNEXPECTED_FUN:
  case mu::ecUNEXPECTED_STR:
  case mu::ecUNEXPECTED_CONDITIONAL:
    return quoted + " cannot stand there (is an operator missing?)";
  case mu::ecMISSING_ELSE_CLAUSE:
    return "'?' needs a ':'";
  case mu::ecMISPLACED_COLON:
    return "':' stands without '?'";
  default:
    return token.empty() ? "it cannot be read" : quoted + " cannot be read";
  }
}

} // namespace

Expression Expression::read(const std::string &text, std::string &fault, std::size_t &column)
{
  char *end = nullptr;
  const PetscReal number = std::strtod(text.c_str(), &end); // it also reads 0x10
  Expression result;

  fault.clear();
  column = 1;
  if (!text.empty() && *end == '\0' && std::isfinite(number) && text.find_first_of("xX") == std::string::npos)
    return {number};
  // muparser would set a variable
  for (std::size_t i = 0; i < text.size(); ++i) {
    if (text[i] != '=') continue;
    if (i + 1 < text.size() && text[i + 1] == '=') {
      ++i;
      continue;
    }
    if (i > 0 && (text[i - 1] == '<' || text[i - 1] == '>' || text[i - 1] == '!')) continue;
    fault = "'=' cannot stand there (== compares)";
    column = i + 1;
    return result;
  }
  auto formula = std::make_shared<Formula>();
  try {
    mu::Parser &parser = formula->parser;
    parser.DefineVar("x", &formula->x);
    parser.DefineVar("y", &formula->y);
    parser.DefineVar("z", &formula->z);
    parser.DefineVar("t", &formula->t);
    parser.DefineConst("pi", PETSC_PI);
    parser.SetExpr(text);
    formula->text = text;
    const PetscReal value = parser.Eval();
    const auto &used = parser.GetUsedVar();
    int results = 1;
    parser.Eval(results); // of a list muparser takes the last
    if (results != 1) {
      fault = "a comma cannot stand there";
      column = text.find(',') + 1;
      return result;
    }
    formula->of_place = used.count("x") + used.count("y") + used.count("z") > 0;
    if (!used.empty()) {
      result.formula_ = formula;
    } else {
      result.number_ = value;
      if (!std::isfinite(value)) fault = "its value is not a number";
    }
  } catch (const mu::Parser::exception_type &error) {
    fault = words(error, text, column);
  }
  return result;
}

std::string Expression::text() const
{
  if (formula_) return formula_->text;
  std::ostringstream number;
  number << number_;
  return number.str();
}

bool Expression::of_place() const
{
  return formula_ && formula_->of_place;
}

PetscReal Expression::evaluate(PetscReal t, const PetscReal x[3]) const
{
  Formula &f = *formula_;

  if (!f.of_place && t == f.time) return f.value;
  f.x = x[0];
  f.y = x[1];
  f.z = x[2];
  f.t = t;
  try {
    f.value = f.parser.Eval();
  } catch (const mu::Parser::exception_type &) {
    f.value = std::numeric_limits<PetscReal>::quiet_NaN();
  }
  f.time = t;
  return f.value;
}

} // namespace pulmo
