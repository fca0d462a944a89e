/* Calls every function of webots_mcp.h with hostile numbers and texts, drawn from a fixed seed. */
#include <float.h>
#include <limits.h>
#include <math.h>

#include "webots_mcp.h"

static uint64_t seed = 88172645463325252u;

static size_t next(size_t below) {
  seed ^= seed << 13;
  seed ^= seed >> 7;
  seed ^= seed << 17;
  return (size_t)(seed % below);
}

int main(void) {
  static char texts[6][300000];
  const double numbers[] = {NAN, -NAN, INFINITY, -INFINITY, DBL_MAX, -DBL_MAX, DBL_MIN,
                            5e-324, -5e-324, 0.0, -0.0, -1.0, 1e15, 1e-36, 9007199254740992.0, 32.0};
  const int wholes[] = {INT_MIN, -1, 0, 1, 2, INT_MAX};
  const size_t count = sizeof numbers / sizeof *numbers;
  memset(texts[1], 'x', 299999);
  memset(texts[2], 0x80, 299999); /* no UTF-8 */
  memset(texts[3], 0xF0, 3000);
  for (int i = 0; i < 31; i++) texts[4][i] = (char)(i + 1);
  strcpy(texts[5], "level");
  const char *choices[] = {NULL, texts[0], texts[1], texts[2], texts[3], texts[4], texts[5], "info"};
#define TEXT choices[next(8)]
#define NUMBER numbers[next(count)]
  for (int session = 0; session < 40; session++) {
    wmcp *w = wmcp_open(NULL, TEXT, TEXT, numbers[(size_t)session % count], wholes[next(6)]);
    for (int call = 0; call < 60; call++) {
      float floats[3] = {(float)INFINITY, (float)NAN, FLT_MIN};
      switch (next(9)) {
        case 0: wmcp_begin(w, NUMBER); break;
        case 1: wmcp_number(w, TEXT, NUMBER); break;
        case 2: wmcp_integer(w, TEXT, next(2) ? LLONG_MIN : LLONG_MAX); break;
        case 3: wmcp_flag(w, TEXT, wholes[next(6)]); break;
        case 4: wmcp_text(w, TEXT, TEXT); break;
        case 5: wmcp_array(w, TEXT, next(4) ? numbers : NULL, next(4) ? next(count) : SIZE_MAX); break;
        case 6: wmcp_floats(w, TEXT, next(4) ? floats : NULL, next(4) ? next(4) : SIZE_MAX); break;
        case 7: wmcp_log(w, TEXT, TEXT); break;
        default: wmcp_publish(w);
      }
    }
    wmcp_close(w);
  }
  wmcp_begin(NULL, 0.0);
  wmcp_publish(NULL);
  wmcp_log(NULL, NULL, NULL);
  return 0;
}
