/* webots_mcp.h: records what a Webots controller in C or C++ publishes, for webots-mcp to read.

       wmcp *w = wmcp_open(NULL, wb_robot_get_name(), wb_robot_get_world_path(),
                           wb_robot_get_basic_time_step(), 0);
       while (wb_robot_step(step) != -1) {
         wmcp_begin(w, wb_robot_get_time());
         wmcp_number(w, "front.m", distance);
         wmcp_text(w, "mode", "search");
         wmcp_publish(w);
       }
       wmcp_close(w);

   C99 or C++11, one file, nothing to link. It appends lines, each with one write(), to a journal in
   the data folder (webots-mcp help journal), which servers and commands of webots-mcp take into the
   database. What was published survives a killed controller. No function waits, fails or stops the
   robot: what cannot be written is counted, tried again each second, and reported as an event
   "dropped". NULL does no harm as a wmcp, a name or a text. A wmcp is used by one thread at a time:
   where several do, put a lock of yours around it. A forked child must leave its parent's alone.

   Tested on Linux; on macOS and Windows it is not tested yet. MIT license. */
#ifndef WEBOTS_MCP_H
#define WEBOTS_MCP_H

#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#ifdef _WIN32
#include <direct.h>
#include <io.h>
#include <windows.h>
#else
#include <sys/file.h>
#include <sys/time.h>
#include <sys/utsname.h>
#include <unistd.h>
#endif

#ifdef __cplusplus
extern "C" {
#elif !defined(_WIN32) /* -std=c99 hides them where another header was included before this one */
int ftruncate(int, off_t);
ssize_t readlink(const char *, char *, size_t);
#endif

#ifndef WMCP_PART_BYTES
#define WMCP_PART_BYTES 16000000 /* a journal that is longer goes on in another file */
#endif
#define WMCP_MAX_ROW 1000000 /* bytes of a row, a text, a log line, a name; items of an array */
#define WMCP_MAX_TEXT 100000
#define WMCP_MAX_LOG 10000
#define WMCP_MAX_NAME 200
#define WMCP_MAX_ITEMS 20000
#define WMCP_PATH 4096

typedef struct {
  char *data;
  size_t length, size;
  int is_cut; /* there was no memory for the rest */
} wmcp__text;

typedef struct wmcp {
  char folder[WMCP_PATH], path[WMCP_PATH + 100], world[WMCP_PATH], uuid[37], run[37], why[200];
  wmcp__text row, replaced, log, extra, header;
  double step_ms, sim_time_s, run_sim_time_s, run_wall_time_s, retry_at_s;
  long long number, bytes, dropped, unreported;
  unsigned long long calls;
  const char *start_reason;
  int interval, part, file, is_due, is_described, is_torn, values;
} wmcp;

/* -- text -------------------------------------------------------------------------------------- */

static inline void wmcp__put(wmcp__text *text, const char *bytes, size_t count) {
  if (text->size - text->length < count) {
    size_t size = 2 * (text->size + count) + 1024;
    char *data = (char *)realloc(text->data, size);
    if (!data) { text->is_cut = 1; return; }
    text->data = data;
    text->size = size;
  }
  if (count) memcpy(text->data + text->length, bytes, count);
  text->length += count;
}

static inline char *wmcp__digits(char *end, uint64_t value) { /* written before `end` */
  do *--end = (char)('0' + value % 10);
  while ((value /= 10) != 0);
  return end;
}

static inline void wmcp__whole(wmcp__text *text, long long value) {
  char digits[24], *end = digits + 24;
  char *at = wmcp__digits(end, value < 0 ? 0 - (uint64_t)value : (uint64_t)value);
  if (value < 0) *--at = '-';
  wmcp__put(text, at, (size_t)(end - at));
}

/* A JSON string; returns its length where it was longer than `limit` bytes and is cut. */
static inline size_t wmcp__string(wmcp__text *text, const char *value, size_t limit) {
  size_t length = strlen(value), end = length < limit ? length : limit;
  while (end < length && (value[end] & 0xC0) == 0x80 && end + 4 > limit) end--; /* UTF-8 */
  wmcp__put(text, "\"", 1);
  for (size_t at = 0, plain = 0; at <= end; at++) {
    unsigned char c = (unsigned char)value[at];
    if (at < end && c >= 0x20 && c != '"' && c != '\\') continue;
    wmcp__put(text, value + plain, at - plain);
    plain = at + 1;
    char escaped[8];
    if (at < end) wmcp__put(text, escaped, (size_t)snprintf(escaped, 8, "\\u%04x", c));
  }
  wmcp__put(text, "\"", 1);
  return length > end ? length : 0;
}

/* -- numbers: what Python's float() reads is the same to the last bit -------------------------- */

static inline uint64_t wmcp__multiply(uint64_t a, uint64_t b, uint64_t *high) {
  uint64_t half = 0xFFFFFFFF, low = (a & half) * (b & half);
  uint64_t left = (a >> 32) * (b & half), right = (a & half) * (b >> 32);
  uint64_t middle = (low >> 32) + (left & half) + (right & half);
  *high = (a >> 32) * (b >> 32) + (left >> 32) + (right >> 32) + (middle >> 32);
  return (low & half) | middle << 32;
}

/* mantissa * 5^power / 2^shift, to the nearest whole number. Exact up to 5^27, which 64 bits hold;
   beyond it off by 1e-19 of it, where another double would be 1e-16 away. */
static inline uint64_t wmcp__scaled(uint64_t mantissa, int power, int shift) {
  uint64_t five = 1, high, low;
  if (power > 27) {
    low = wmcp__multiply(mantissa, 7450580596923828125, &high);
    mantissa = high << 12 | low >> 52;
    power -= 27;
    shift -= 52;
  }
  for (uint64_t base = 5; power; base *= base, power >>= 1)
    if (power & 1) five *= base;
  low = wmcp__multiply(mantissa, five, &high);
  for (; shift > 63; shift--, high >>= 1) low = low >> 1 | high << 63;
  uint64_t bit = (uint64_t)1 << (shift - 1), sum = low + bit;
  uint64_t whole = (sum >> shift) | ((high + (sum < low)) << (64 - shift));
  return (low & (2 * bit - 1)) == bit ? whole & ~(uint64_t)1 : whole; /* a tie: to the even one */
}

static inline const char *wmcp__not_finite(double value) { /* by its bits: -ffast-math has no NaN */
  uint64_t bits;
  memcpy(&bits, &value, sizeof bits);
  if ((bits >> 52 & 0x7FF) != 0x7FF) return NULL;
  return bits << 12 ? "nan" : bits >> 63 ? "-inf" : "inf";
}

/* A number, by the 17 digits that are nearest to it; null where it is not finite. */
static inline void wmcp__double(wmcp__text *text, double value) {
  char out[64], *end = out + 64, *at;
  double size = value < 0 ? -value : value;
  uint64_t bits;
  if (wmcp__not_finite(value)) { wmcp__put(text, "null", 4); return; }
  memcpy(&bits, &value, sizeof bits);
  if (bits >> 63) wmcp__put(text, "-", 1);
  if (size < 9007199254740992.0 && size == (double)(int64_t)size) {
    wmcp__whole(text, (long long)size);
    wmcp__put(text, ".0", 2);
  } else if (!(size >= 1e-36 && size < 1e15)) { /* the library's; the locale has its own point */
    snprintf(out, sizeof out, "%.16e", size);
    at = strchr(out, 'e');
    wmcp__put(text, out, 1);
    wmcp__put(text, ".", 1);
    wmcp__put(text, at - 16, 16 + strlen(at));
  } else {
    uint64_t mantissa = (bits & 0xFFFFFFFFFFFFF) | 0x10000000000000;
    int exponent = (int)(bits >> 52 & 0x7FF) - 1075;
    int point = 17 - (((exponent + 53) * 1233) >> 12); /* digits after the point, or one more */
    uint64_t digits = wmcp__scaled(mantissa, point, -exponent - point);
    if (digits >= 100000000000000000)
      point--, digits = wmcp__scaled(mantissa, point, -exponent - point);
    for (; point > 1 && digits % 10 == 0; point--) digits /= 10;
    at = wmcp__digits(end, digits);
    if (point > 20) {
      wmcp__put(text, at, (size_t)(end - at));
      wmcp__put(text, "e-", 2);
      wmcp__whole(text, point);
      return;
    }
    while (end - at <= point) *--at = '0';
    wmcp__put(text, at, (size_t)(end - at - point));
    wmcp__put(text, ".", 1);
    wmcp__put(text, end - point, (size_t)point);
  }
}

/* Text as it is but for @ a text, $ a JSON string or null, # a whole number, % a number. */
static inline void wmcp__format(wmcp__text *text, const char *format, ...) {
  va_list values;
  va_start(values, format);
  for (const char *at = format; *at; at++) {
    const char *value = *at == '@' || *at == '$' ? va_arg(values, const char *) : NULL;
    if (*at == '$' && value)
      wmcp__string(text, value, WMCP_PATH);
    else if (*at == '$' || *at == '@')
      wmcp__put(text, value ? value : "null", value ? strlen(value) : 4);
    else if (*at == '#')
      wmcp__whole(text, va_arg(values, long long));
    else if (*at == '%')
      wmcp__double(text, va_arg(values, double));
    else
      wmcp__put(text, at, 1);
  }
  va_end(values);
}

/* -- the system -------------------------------------------------------------------------------- */

#ifdef _WIN32
#define WMCP_HOME "USERPROFILE"
#define WMCP_FLAGS (_O_WRONLY | _O_CREAT | _O_EXCL | _O_APPEND | _O_BINARY | _O_NOINHERIT)
#define wmcp__cut(file, bytes) _chsize_s(file, bytes)
#define wmcp__make(path) _mkdir(path)
static inline double wmcp__now_s(void) {
  FILETIME time;
  GetSystemTimeAsFileTime(&time);
  return (double)((uint64_t)time.dwHighDateTime << 32 | time.dwLowDateTime) / 1e7 - 11644473600.0;
}

static inline int wmcp__lock(int file) { /* the byte that webots-mcp itself asks for */
  OVERLAPPED at;
  memset(&at, 0, sizeof at);
  at.OffsetHigh = 1 << 8;
  return LockFileEx((HANDLE)_get_osfhandle(file),
                    LOCKFILE_EXCLUSIVE_LOCK | LOCKFILE_FAIL_IMMEDIATELY, 0, 1, 0, &at);
}
#else
#define WMCP_HOME "HOME"
#define WMCP_FLAGS (O_WRONLY | O_CREAT | O_EXCL | O_APPEND)
#define wmcp__cut(file, bytes) ftruncate(file, (off_t)(bytes))
#define wmcp__make(path) mkdir(path, 0700)
static inline double wmcp__now_s(void) {
  struct timeval now;
  gettimeofday(&now, NULL);
  return (double)now.tv_sec + (double)now.tv_usec / 1e6;
}

static inline int wmcp__lock(int file) { /* some network drives have none */
  fcntl(file, F_SETFD, FD_CLOEXEC);
  return flock(file, LOCK_EX | LOCK_NB) == 0 || errno != EWOULDBLOCK;
}
#endif

static inline void wmcp__new_uuid(char *text) { /* RFC 9562, version 4 */
  static uint64_t count;
  uint64_t parts[2] = {(uint64_t)(wmcp__now_s() * 1e6) << 8 ^ ++count, (uint64_t)(uintptr_t)text};
  FILE *random = fopen("/dev/urandom", "rb");
  if (random && fread(parts, sizeof parts, 1, random) != 1) count++;
  if (random) fclose(random);
  snprintf(text, 37, "%08x-%04x-4%03x-%04x-%012llx", (unsigned)(parts[0] >> 32),
           (unsigned)(parts[0] >> 16 & 0xFFFF), (unsigned)(parts[0] & 0xFFF),
           (unsigned)(parts[1] >> 48 & 0x3FFF) | 0x8000,
           (unsigned long long)(parts[1] & 0xFFFFFFFFFFFF));
}

static inline int wmcp__has(const char *path, const char *folder) {
  char text[WMCP_PATH + 20];
  struct stat status;
  snprintf(text, sizeof text, "%s/%s/.", path, folder);
  return stat(text, &status) == 0;
}

/* As webots-mcp itself chooses: what is named, WEBOTS_MCP_DATA_DIR, mcp_data of the project around
   the working folder, ~/.webots-mcp/data. */
static inline void wmcp__find_folder(char *path, const char *named) {
  const char *home = getenv(WMCP_HOME) ? getenv(WMCP_HOME) : ".";
  char *end = getcwd(path, WMCP_PATH - 20);
  if (!named || !*named) named = getenv("WEBOTS_MCP_DATA_DIR");
  if (named && *named) {
    int in_home = named[0] == '~' && (named[1] == '/' || !named[1]);
    snprintf(path, WMCP_PATH, "%s%s", in_home ? home : "", named + in_home);
    return;
  }
  while (end && !(wmcp__has(path, "worlds") && wmcp__has(path, "controllers"))) {
    for (end = path + strlen(path); end > path && *end != '/' && *end != '\\';) end--;
    *end = 0;
    if (end == path) end = NULL;
  }
  if (end) strcat(path, "/mcp_data");
  if (!end) snprintf(path, WMCP_PATH, "%s/.webots-mcp/data", home);
}

static inline void wmcp__make_folder(char *path) { /* and those around it */
  for (char *at = path + 1, kept = 1; kept; *at++ = kept) {
    at += strcspn(at, "/\\");
    kept = *at;
    *at = 0;
    wmcp__make(path);
  }
}

/* -- the journal ------------------------------------------------------------------------------- */

static inline int wmcp__append(wmcp *w, const wmcp__text *line) { /* all of it or nothing */
  if (w->is_torn && write(w->file, "\n", 1) == 1) w->is_torn = 0, w->bytes++;
  if (w->is_torn || line->is_cut) return 0;
  errno = ENOSPC; /* where only a part is written */
  long long done = (long long)write(w->file, line->data, (unsigned)line->length);
  if (done == (long long)line->length) return (w->bytes += done) > 0;
  if (done > 0) w->is_torn = wmcp__cut(w->file, w->bytes) != 0;
  return 0;
}

static inline void wmcp__put_run(wmcp *w) { /* before the line that needs it */
  wmcp__format(&w->extra, "[#,\"run\",null,{\"uuid\":$,\"world\":$,\"step_ms\":%,\"reason\":$,",
               w->number - 2, w->run, w->world[0] ? w->world : NULL, w->step_ms, w->start_reason);
  wmcp__format(&w->extra, "\"wall_time\":%,\"sim_time\":%}]\n", w->run_wall_time_s,
               w->run_sim_time_s);
}

/* Goes on in a new file, which begins with who records and the run; 0 where it cannot be made. */
static inline int wmcp__begin_part(wmcp *w) {
  int before = w->file, why;
  long long bytes = w->bytes;
  snprintf(w->path, sizeof w->path, "%s/webots.db-waiting-%s-%04d.jsonl", w->folder, w->uuid,
           w->part + 1);
  if ((w->file = open(w->path, WMCP_FLAGS, 0600)) < 0 && errno == ENOENT) {
    wmcp__make_folder(w->folder);
    w->file = open(w->path, WMCP_FLAGS, 0600);
  }
  w->bytes = w->is_torn = 0;
  w->extra.length = 0;
  wmcp__put(&w->extra, w->header.data, w->header.length);
  if (w->run[0]) wmcp__put_run(w);
  if (w->file >= 0 && wmcp__lock(w->file) && wmcp__append(w, &w->extra)) {
    if (before >= 0) close(before);
    w->part++;
    return w->is_described = 1;
  }
  why = errno;
  if (w->file >= 0) close(w->file), remove(w->path);
  errno = why;
  w->file = before;
  w->bytes = bytes;
  return 0;
}

/* Makes sure that there is a journal, with the run in it and what was dropped. */
static inline int wmcp__is_ready(wmcp *w, size_t count) {
  struct stat status;
  if (w->file >= 0 && (fstat(w->file, &status) || !status.st_nlink)) { /* it was deleted */
    close(w->file);
    w->file = -1;
  }
  if (w->file < 0 || w->bytes + (long long)count > WMCP_PART_BYTES)
    if (!wmcp__begin_part(w) && w->file < 0) return 0;
  w->extra.length = 0;
  if (!w->is_described) wmcp__put_run(w);
  if (!w->is_described && !(w->is_described = wmcp__append(w, &w->extra))) return 0;
  w->extra.length = 0;
  if (!w->unreported) return 1;
  wmcp__format(&w->extra, "[#,\"event\",$,[%,%,\"dropped\",null,{\"row_count\":#,\"why\":$}]]\n",
               w->number - 1, w->run, w->sim_time_s, wmcp__now_s(), w->unreported, w->why);
  if (!wmcp__append(w, &w->extra)) return 0;
  w->unreported = 0;
  return 1;
}

#define WMCP_NUMBER "[                " /* it is known when the line is written, to end here */

/* Appends the line, or counts it as dropped. */
static inline void wmcp__write_line(wmcp *w, const wmcp__text *line) {
  double now_s = wmcp__now_s();
  w->number += 4; /* those between are of the run and of what was dropped */
  if (!line->is_cut) wmcp__digits(line->data + sizeof WMCP_NUMBER - 1, (uint64_t)w->number);
  if (!(now_s >= w->retry_at_s - 1.0 && now_s < w->retry_at_s)) { /* a clock may be set back */
    errno = ENOMEM;
    w->retry_at_s = 0.0;
    if (wmcp__is_ready(w, line->length) && wmcp__append(w, line)) return;
    const char *why = strerror(errno);
    if (strcmp(why, w->why)) fprintf(stderr, "webots_mcp.h: not recording, %s: %s\n", w->path, why);
    snprintf(w->why, sizeof w->why, "%s", why);
    w->retry_at_s = now_s + 1.0;
  }
  w->dropped++;
  w->unreported++;
}

static inline void wmcp__begin_run(wmcp *w, double sim_time_s) {
  wmcp__new_uuid(w->run);
  w->run_sim_time_s = sim_time_s;
  w->run_wall_time_s = wmcp__now_s();
  w->is_described = 0;
}

static inline void wmcp__start_line(wmcp *w, wmcp__text *line, const char *kind) {
  if (!w->run[0]) wmcp__begin_run(w, w->sim_time_s);
  line->length = 0;
  line->is_cut = 0;
  wmcp__format(line, WMCP_NUMBER ",\"@\",\"@\",[%,%,", kind, w->run, w->sim_time_s, wmcp__now_s());
}

static inline void wmcp__end_run(wmcp *w, const char *reason) {
  w->log.length = 0;
  w->log.is_cut = 0;
  wmcp__format(&w->log, WMCP_NUMBER ",\"run end\",$,{\"reason\":$,\"now\":%,\"sim_time\":%}]\n",
               w->run, reason, wmcp__now_s(), w->sim_time_s);
  wmcp__write_line(w, &w->log);
}

/* Names a value that is stored otherwise, or all nulls in an array. */
static inline void wmcp__replace(wmcp *w, const char *name, const char *what, int in_array) {
  wmcp__put(&w->replaced, w->replaced.length ? "," : "{", 1);
  wmcp__string(&w->replaced, name, WMCP_MAX_NAME);
  if (in_array) w->replaced.length--, wmcp__put(&w->replaced, ".*\"", 3);
  wmcp__format(&w->replaced, ":\"@\"", what);
}

static inline int wmcp__start_value(wmcp *w, const char *name) {
  if (!w || !w->is_due || !name) return 0;
  if (w->row.length + w->replaced.length > WMCP_MAX_ROW) {
    if (w->values) wmcp__replace(w, "", "too large", 0);
    return w->values = 0;
  }
  if (w->values++) wmcp__put(&w->row, ",", 1);
  wmcp__string(&w->row, name, WMCP_MAX_NAME);
  wmcp__put(&w->row, ":", 1);
  return 1;
}

/* -- what a controller calls ------------------------------------------------------------------- */

/* Begins to record, in the data folder `data_dir`; NULL: found as webots-mcp finds it. Of so many
   states as `throttle_interval` says one is recorded, 0: of 5; the environment variable
   WEBOTS_MCP_THROTTLE_INTERVAL has the last word. NULL is returned where there is no memory. */
static inline wmcp *wmcp_open(const char *data_dir, const char *robot, const char *world,
                              double basic_time_step_ms, int throttle_interval) {
  wmcp *w = (wmcp *)calloc(1, sizeof(wmcp));
  const char *interval = getenv("WEBOTS_MCP_THROTTLE_INTERVAL"), *host = NULL;
  char program[WMCP_PATH] = "";
  if (!w) return NULL;
  long given = interval ? strtol(interval, NULL, 10) : 0;
  if (given > 0) throttle_interval = given < 1000000000 ? (int)given : 1000000000;
  w->interval = throttle_interval > 0 ? throttle_interval : 5;
  w->step_ms = basic_time_step_ms;
  w->start_reason = "start";
  w->file = -1;
  w->is_described = 1;
  wmcp__new_uuid(w->uuid);
  wmcp__find_folder(w->folder, data_dir);
  snprintf(w->world, sizeof w->world, "%s", world ? world : "");
#ifdef _WIN32
  host = getenv("COMPUTERNAME");
  GetModuleFileNameA(NULL, program, WMCP_PATH - 1);
  long long pid = (long long)GetCurrentProcessId(), parent = 0;
#else
  struct utsname names;
  if (uname(&names) >= 0) host = names.nodename;
  if (readlink("/proc/self/exe", program, WMCP_PATH - 1) < 0) program[0] = 0;
  long long pid = getpid(), parent = getppid();
#endif
  wmcp__format(&w->header, "{\"webots_mcp_waiting\":1,\"robot\":{\"name\":$},\"session\":{",
               robot && *robot ? robot : "robot");
  wmcp__format(&w->header, "\"uuid\":$,\"pid\":#,\"parent_pid\":#,\"host\":$,\"controller\":$,",
               w->uuid, pid, parent, host ? host : "", program[0] ? program : NULL);
  wmcp__format(&w->header, "\"versions\":{\"webots_mcp.h\":\"1\"},\"throttle_interval\":#,",
               (long long)w->interval);
  wmcp__format(&w->header, "\"started_wall_time_s\":%,\"environment\":{", wmcp__now_s());
  wmcp__format(&w->header, "\"WEBOTS_INSTANCE_PATH\":$,\"WEBOTS_ROBOT_NAME\":$,",
               getenv("WEBOTS_INSTANCE_PATH"), getenv("WEBOTS_ROBOT_NAME"));
  wmcp__format(&w->header, "\"WEBOTS_CONTROLLER_URL\":$}}}\n", getenv("WEBOTS_CONTROLLER_URL"));
  wmcp__begin_part(w);
  return w;
}

/* Begins a state at this simulation time, s; a time that went back begins a new run. */
static inline void wmcp_begin(wmcp *w, double sim_time_s) {
  if (!w || wmcp__not_finite(sim_time_s)) return;
  int is_reset = w->run[0] && sim_time_s < w->sim_time_s - 1e-9;
  if (is_reset) wmcp__end_run(w, "reset");
  w->sim_time_s = sim_time_s;
  if (!w->run[0]) { /* a step ago, as the controller began before it */
    int is_step = !wmcp__not_finite(w->step_ms) && w->step_ms > 0.0;
    double start_s = is_step ? sim_time_s - w->step_ms / 1000.0 : sim_time_s;
    wmcp__begin_run(w, start_s > 1e-9 ? start_s : 0.0);
  }
  if (is_reset) {
    w->start_reason = "reset";
    w->calls = 0;
    wmcp__begin_run(w, sim_time_s);
    wmcp__start_line(w, &w->row, "event");
    wmcp__put(&w->row, "\"reset\"]]\n", 10);
    wmcp__write_line(w, &w->row);
  }
  if (!(w->is_due = ++w->calls % (unsigned)w->interval == 0)) return;
  wmcp__start_line(w, &w->row, "state");
  wmcp__put(&w->row, "{", 1);
  w->replaced.length = 0;
  w->values = 0;
}

/* A number; "front.m" is m in the object front. NaN and infinities are stored as null and named. */
static inline void wmcp_number(wmcp *w, const char *name, double value) {
  if (!wmcp__start_value(w, name)) return;
  const char *what = wmcp__not_finite(value);
  if (what) wmcp__replace(w, name, what, 0);
  wmcp__format(&w->row, what ? "null" : "%", value);
}

static inline void wmcp_integer(wmcp *w, const char *name, long long value) {
  if (wmcp__start_value(w, name)) wmcp__whole(&w->row, value);
}

static inline void wmcp_flag(wmcp *w, const char *name, int value) {
  if (wmcp__start_value(w, name)) wmcp__format(&w->row, value ? "true" : "false");
}

/* A text in UTF-8, of which 100,000 bytes are kept; NULL is null. */
static inline void wmcp_text(wmcp *w, const char *name, const char *value) {
  if (!wmcp__start_value(w, name)) return;
  size_t cut = value ? wmcp__string(&w->row, value, WMCP_MAX_TEXT) : 0;
  if (!value) wmcp__put(&w->row, "null", 4);
  if (cut) wmcp__replace(w, name, "too large", 0);
}

/* An array of at most 20,000 numbers. */
static inline void wmcp_array(wmcp *w, const char *name, const double *values, size_t count) {
  const char *what, *first = NULL;
  int is_mixed = 0, is_whole = values && count <= WMCP_MAX_ITEMS;
  if (!wmcp__start_value(w, name)) return;
  wmcp__format(&w->row, is_whole ? "[" : "null");
  if (values && !is_whole) wmcp__replace(w, name, "too large", 0);
  for (size_t i = 0; is_whole && i < count; i++) {
    if (i) wmcp__put(&w->row, ",", 1);
    what = wmcp__not_finite(values[i]);
    wmcp__format(&w->row, what ? "null" : "%", values[i]);
    is_mixed |= what && first && what != first;
    first = what ? what : first;
  }
  if (is_whole) wmcp__put(&w->row, "]", 1);
  if (first) wmcp__replace(w, name, is_mixed ? "not finite" : first, 1);
}

/* The same of floats, as lidars and range finders give them. */
static inline void wmcp_floats(wmcp *w, const char *name, const float *values, size_t count) {
  if (!w || !w->is_due) return;
  w->extra.length = 0;
  for (size_t i = 0; values && i < count && count <= WMCP_MAX_ITEMS; i++) {
    double value = values[i];
    wmcp__put(&w->extra, (const char *)&value, sizeof value);
  }
  wmcp__put(&w->extra, "", 1); /* so that there is one */
  if (!w->extra.is_cut) wmcp_array(w, name, values ? (double *)(void *)w->extra.data : NULL, count);
}

/* Records the state that was begun, if it is one of those that are recorded. */
static inline void wmcp_publish(wmcp *w) {
  if (!w || !w->is_due) return;
  w->is_due = 0;
  wmcp__put(&w->row, "},", 2);
  wmcp__put(&w->row, w->replaced.data, w->replaced.length);
  wmcp__format(&w->row, w->replaced.length ? "}]]\n" : "null]]\n");
  wmcp__write_line(w, &w->row);
}

/* Logs a line of at most 10,000 bytes; level: debug, info, warning, error or critical. */
static inline void wmcp_log(wmcp *w, const char *level, const char *message) {
  if (!w) return;
  wmcp__start_line(w, &w->log, "log");
  wmcp__format(&w->log, "$,\"controller\",", level ? level : "info");
  wmcp__string(&w->log, message ? message : "", WMCP_MAX_LOG);
  wmcp__put(&w->log, "]]\n", 3);
  wmcp__write_line(w, &w->log);
}

/* Ends the session: call it when wb_robot_step() has returned -1. */
static inline void wmcp_close(wmcp *w) {
  if (!w) return;
  if (w->run[0]) wmcp__end_run(w, "finished");
  w->log.length = 0;
  w->log.is_cut = 0;
  wmcp__format(&w->log, WMCP_NUMBER ",\"session end\",null,{\"reason\":\"finished\",\"now\":%,",
               wmcp__now_s());
  wmcp__format(&w->log, "\"dropped\":#}]\n", w->dropped);
  wmcp__write_line(w, &w->log);
  if (w->file >= 0) close(w->file);
  wmcp__text *texts[] = {&w->row, &w->replaced, &w->log, &w->extra, &w->header};
  for (int i = 0; i < 5; i++) free(texts[i]->data);
  free(w);
}

#ifdef __cplusplus
}
#endif
#endif
