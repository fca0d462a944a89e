/* As much of Webots' C library as the e-puck of the examples calls, on one line of stdin a step: the
   time, what the wheels have turned, and what the eyes read. The speeds of the wheels are printed. */
#ifndef STUB_H
#define STUB_H
#include <stdio.h>
#include <string.h>

typedef unsigned short WbDeviceTag;
static double stub_values[11], stub_speeds[2];

static inline int wb_robot_init(void) { return 0; }
static inline void wb_robot_cleanup(void) {}
static inline const char *wb_robot_get_name(void) { return "e-puck"; }
static inline const char *wb_robot_get_world_path(void) { return "e_puck.wbt"; }
static inline double wb_robot_get_basic_time_step(void) { return 32.0; }
static inline double wb_robot_get_time(void) { return stub_values[0]; }
static inline WbDeviceTag wb_robot_get_device(const char *name) {
  if (name[0] == 'p') return (WbDeviceTag)(3 + name[2] - '0');
  return name[0] == 'l' ? 1 : 2;
}
static inline int wb_robot_step(int duration_ms) {
  static int steps;
  if (steps++) printf("%.17g %.17g\n", stub_speeds[0], stub_speeds[1]);
  for (int i = 0; i < 11; i++)
    if (duration_ms < 1 || scanf("%lf", stub_values + i) != 1) return -1;
  return 0;
}
static inline void wb_distance_sensor_enable(WbDeviceTag tag, int ms) { (void)tag, (void)ms; }
static inline void wb_position_sensor_enable(WbDeviceTag tag, int ms) { (void)tag, (void)ms; }
static inline double wb_distance_sensor_get_value(WbDeviceTag tag) { return stub_values[tag]; }
static inline double wb_position_sensor_get_value(WbDeviceTag tag) { return stub_values[tag]; }
static inline void wb_motor_set_position(WbDeviceTag tag, double rad) { (void)tag, (void)rad; }
static inline void wb_motor_set_velocity(WbDeviceTag tag, double speed) {
  stub_speeds[tag - 1] = speed;
}
#endif
