/* Calls webots_mcp.h as it is told on stdin, one call a line, or prints numbers; texts are in hex.

   Between two setlocale lines a standard header comes first, as -std=c99 then hides what it can. */
#include <locale.h>
#include <signal.h>
#include <stdio.h>

#include "webots_mcp.h"

static uint64_t seed = 88172645463325252u;

static uint64_t next(void) {
  seed ^= seed << 13;
  seed ^= seed >> 7;
  seed ^= seed << 17;
  return seed;
}

static double power(double base, int exponent) {
  double value = 1.0;
  for (int i = 0; i < (exponent < 0 ? -exponent : exponent); i++) value *= base;
  return exponent < 0 ? 1.0 / value : value;
}

/* Doubles of all kinds: any bits, rounded sensors, all sizes, floats, integers, next to powers of 2. */
static double draw(long i) {
  uint64_t bits = next();
  double value;
  switch (i % 6) {
    case 0: memcpy(&value, &bits, sizeof value); return value;
    case 1: return (double)(int64_t)(bits % 2000001 - 1000000) / 1000.0;
    case 2: return (double)(bits >> 11) / 9007199254740992.0 * power(10, (int)(bits % 56) - 38);
    case 3: return (double)(float)((double)(bits >> 40) / 1e4);
    case 4: return (double)(int64_t)bits;
    default: return (1.0 + (double)(bits >> 60) * 2.220446049250313e-16) * power(2, (int)(bits % 200) - 140);
  }
}

static int print_numbers(long count) {
  for (long i = 0; i < count; i++) {
    wmcp__text text = {NULL, 0, 0, 0};
    double value = draw(i);
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    if (!wmcp__not_finite(value)) {
      wmcp__double(&text, value);
      printf("%016llx %.*s\n", (unsigned long long)bits, (int)text.length, text.data);
    }
    free(text.data);
  }
  return 0;
}

static char *from_hex(char *text) { /* "-" is NULL */
  char *to = text;
  unsigned byte;
  if (text[0] == '-') return NULL;
  for (char *at = text; sscanf(at, "%2x", &byte) == 1; at += 2) *to++ = (char)byte;
  *to = 0;
  return text;
}

/* The rows of a robot, without end; after each its number is printed. */
static int publish_for_ever(wmcp *w, int rows) {
  for (int i = 1; i <= rows; i++) {
    wmcp_begin(w, i * 0.008);
    wmcp_integer(w, "i", i);
    wmcp_text(w, "mode", i / 50 % 2 ? "drive" : "search");
    wmcp_number(w, "third", i / 3.0);
    wmcp_publish(w);
    printf("%d\n", i);
    fflush(stdout);
  }
  return 0;
}

int main(int count, char **arguments) {
  static char line[2000000], name[4000], text[2000000];
  if (setlocale(LC_ALL, "") == NULL) setlocale(LC_ALL, "C");
#ifdef SIGXFSZ
  signal(SIGXFSZ, SIG_IGN);
#endif
  if (count == 3 && !strcmp(arguments[1], "numbers")) return print_numbers(atol(arguments[2]));
  double step_ms = count == 3 && !strcmp(arguments[1], "step") ? strtod(arguments[2], NULL) : 32.0;
  wmcp *w = wmcp_open(NULL, "rover", "/w/arena.wbt", step_ms, 1);
  if (count == 3 && !strcmp(arguments[1], "forever")) return publish_for_ever(w, atoi(arguments[2]));
  while (fgets(line, sizeof line, stdin)) {
    unsigned long long bits;
    double value = 0.0;
    if (sscanf(line, "begin %lf", &value) == 1) wmcp_begin(w, value);
    if (sscanf(line, "number %3999s %llx", name, &bits) == 2) {
      memcpy(&value, &bits, sizeof value);
      wmcp_number(w, from_hex(name), value);
    }
    if (sscanf(line, "integer %3999s %llx", name, &bits) == 2)
      wmcp_integer(w, from_hex(name), (long long)bits);
    if (sscanf(line, "flag %3999s %llu", name, &bits) == 2) wmcp_flag(w, from_hex(name), (int)bits);
    if (sscanf(line, "text %3999s %1999999s", name, text) == 2)
      wmcp_text(w, from_hex(name), from_hex(text));
    if (sscanf(line, "array %3999s %llu %lf", name, &bits, &value) == 3) { /* of so many, alike */
      double *items = (double *)malloc((bits + 1) * sizeof value);
      for (unsigned long long i = 0; i < bits; i++) items[i] = value;
      if (bits == 7) items[3] = -items[3] * 1e308 * 10.0; /* an infinity */
      wmcp_array(w, from_hex(name), items, bits);
      free(items);
    }
    if (sscanf(line, "floats %3999s %lf", name, &value) == 2) {
      float items[2] = {(float)value, (float)value / 3.0f};
      wmcp_floats(w, from_hex(name), items, 2);
    }
    if (sscanf(line, "log %1999999s", text) == 1) wmcp_log(w, "warning", from_hex(text));
    if (!strncmp(line, "publish", 7)) wmcp_publish(w);
    if (!strncmp(line, "say", 3)) puts("said"), fflush(stdout);
  }
  wmcp_close(w);
  wmcp_close(NULL);
  return 0;
}
