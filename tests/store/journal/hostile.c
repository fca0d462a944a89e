/* Calls every function of webots_mcp.h with numbers and texts that no robot should give it. */
#include <limits.h>
#include <locale.h>
#include <stdio.h>

#include "webots_mcp.h"

static uint64_t seed = 88172645463325252u;

static uint64_t next(void) {
  seed ^= seed << 13;
  seed ^= seed >> 7;
  seed ^= seed << 17;
  return seed;
}

static double from_bits(uint64_t bits) {
  double value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

static double any_double(void) {
  static const uint64_t edges[] = {
    0x0000000000000000u, 0x8000000000000000u, /* zeros */
    0x7FF0000000000000u, 0xFFF0000000000000u, /* infinities */
    0x7FF8000000000000u, 0xFFF8000000000000u, 0x7FF0000000000001u, 0xFFFFFFFFFFFFFFFFu, /* NaN */
    0x0000000000000001u, 0x800FFFFFFFFFFFFFu, 0x0010000000000000u, /* denormal, smallest normal */
    0x7FEFFFFFFFFFFFFFu, 0xFFEFFFFFFFFFFFFFu, /* largest */
    0x43E0000000000000u, 0xC3E0000000000000u, 0x43F0000000000000u, /* 2^63, -2^63, 2^64 */
    0x41DFFFFFFFC00000u, 0xC1E0000000000000u, /* INT_MAX, INT_MIN */
    0x3F50624DD2F1A9FCu, 0x4040000000000000u /* 0.001, 32 */
  };
  uint64_t bits = next();
  return from_bits(bits % 3 ? edges[bits / 3 % (sizeof edges / sizeof edges[0])] : next());
}

static int any_int(void) {
  static const int edges[] = {INT_MIN, INT_MIN + 1, -1, 0, 1, 2, 5, INT_MAX};
  return edges[next() % 8];
}

static char longest[3000000];

static const char *any_text(void) {
  static char bytes[64];
  static const char *const edges[] = {
    "", "a", ".", "..", "a.b", "\"", "\\", "%s%n%d", "@$#%", "\x01\x02\x1f\x7f", "\xff\xfe",
    "\xc3", "\xed\xa0\x80", "\xf0\x9f\xa4\x96", "\xef\xbb\xbf", "\r\n", "../../etc"
  };
  uint64_t draw = next();
  if (draw % 8 == 0) return NULL;
  if (draw % 64 == 1) return longest;
  if (draw % 64 == 2) return longest + sizeof longest - 1 - next() % 200000;
  if (draw % 2) return edges[draw / 64 % (sizeof edges / sizeof edges[0])];
  size_t length = next() % (sizeof bytes - 1);
  for (size_t i = 0; i < length; i++) bytes[i] = (char)next();
  bytes[length] = 0;
  return bytes;
}

static void call(wmcp *w) {
  static double values[30000];
  static float floats[30000];
  static const size_t counts[] = {0, 1, 2, 16, 20000, 20001, 30000, SIZE_MAX};
  size_t count = counts[next() % 16 ? next() % 4 : next() % 8];
  switch (next() % 10) {
    case 0: wmcp_begin(w, any_double()); break;
    case 1: wmcp_number(w, any_text(), any_double()); break;
    case 2: wmcp_integer(w, any_text(), next() % 2 ? LLONG_MIN : (long long)next()); break;
    case 3: wmcp_flag(w, any_text(), any_int()); break;
    case 4: wmcp_text(w, any_text(), any_text()); break;
    case 5:
      for (size_t i = 0; i < count && i < 30000; i++) values[i] = any_double();
      wmcp_array(w, any_text(), next() % 8 ? values : NULL, count);
      break;
    case 6:
      for (size_t i = 0; i < count && i < 30000; i++) {
        uint32_t bits = (uint32_t)next();
        memcpy(&floats[i], &bits, sizeof bits);
      }
      wmcp_floats(w, any_text(), next() % 8 ? floats : NULL, count);
      break;
    case 7: wmcp_log(w, any_text(), any_text()); break;
    default: wmcp_publish(w); break;
  }
}

int main(int count, char **arguments) {
  if (count != 4) return 2;
  seed += (uint64_t)atoll(arguments[1]) * 2654435761u;
  if (setlocale(LC_ALL, "") == NULL) setlocale(LC_ALL, "C");
  for (size_t i = 0; i + 1 < sizeof longest; i++) longest[i] = (char)(i % 255 + 1);
  for (int session = 0; session < atoi(arguments[2]); session++) {
    const char *robot = any_text(), *world = any_text();
    wmcp *w = next() % 16 ? wmcp_open(NULL, robot, world, any_double(), any_int()) : NULL;
    for (int calls = 0; calls < atoi(arguments[3]); calls++) call(w);
    if (next() % 2) { /* so that there is a state that must arrive */
      wmcp_begin(w, 1.5);
      for (int i = 0; i < 5; i++) wmcp_begin(w, 1.5), wmcp_integer(w, "sure", 1), wmcp_publish(w);
    }
    wmcp_close(w);
  }
  puts("well");
  return 0;
}
