/* The e-puck of e_puck_avoid.py in C: it avoids obstacles, reckons its way, and publishes the same.

   What is there of webots-mcp stands in four places: the header, wmcp_open, the state from wmcp_begin
   to wmcp_publish, and wmcp_close. */
#include <math.h>
#include <string.h>
#include <webots/distance_sensor.h>
#include <webots/motor.h>
#include <webots/position_sensor.h>
#include <webots/robot.h>

#include "webots_mcp.h"

#define WHEEL_RADIUS_M 0.02
#define TRACK_M 0.052
#define SPEED_RADPS 4.0
#define THRESHOLD 90.0 /* what a sensor reads where it turns away */

static double eyes[8], wheels_rad[2], x_m, y_m, heading_rad;
static int turns, has_turned;
static const char *mode;

static double most(const int *numbers, int count) {
  double found = eyes[numbers[0]];
  for (int i = 1; i < count; i++)
    if (eyes[numbers[i]] > found) found = eyes[numbers[i]];
  return found;
}

/* At the start, and when the simulation was reset under our feet. */
static void start(void) {
  mode = "cruise";
  turns = has_turned = 0;
  x_m = y_m = heading_rad = 0.0;
}

/* Where it is since the start, from what the wheels have turned. */
static void reckon(double left_rad, double right_rad) {
  double left_m = has_turned ? WHEEL_RADIUS_M * (left_rad - wheels_rad[0]) : 0.0;
  double right_m = has_turned ? WHEEL_RADIUS_M * (right_rad - wheels_rad[1]) : 0.0;
  wheels_rad[0] = left_rad;
  wheels_rad[1] = right_rad;
  has_turned = 1;
  heading_rad += (right_m - left_m) / TRACK_M;
  x_m += (left_m + right_m) / 2.0 * cos(heading_rad);
  y_m += (left_m + right_m) / 2.0 * sin(heading_rad);
}

/* It turns until nothing is ahead of it. */
static void decide(void) {
  const int right[] = {0, 1, 2}, left[] = {5, 6, 7}, ahead[] = {0, 1, 6, 7};
  if (!strcmp(mode, "cruise") && most(ahead, 4) > THRESHOLD) {
    mode = most(right, 3) > most(left, 3) ? "turn_left" : "turn_right";
    turns++;
  } else if (strcmp(mode, "cruise") && most(ahead, 4) < THRESHOLD)
    mode = "cruise";
}

static double left_speed(void) {
  return !strcmp(mode, "turn_left") ? -SPEED_RADPS / 2.0
         : !strcmp(mode, "cruise")  ? SPEED_RADPS
                                    : SPEED_RADPS / 2.0;
}

static double right_speed(void) {
  return !strcmp(mode, "turn_right") ? -SPEED_RADPS / 2.0
         : !strcmp(mode, "cruise")   ? SPEED_RADPS
                                     : SPEED_RADPS / 2.0;
}

static void publish(wmcp *w, double time_s) {
  wmcp_begin(w, time_s);
  wmcp_number(w, "odom.x_m", x_m);
  wmcp_number(w, "odom.y_m", y_m);
  wmcp_number(w, "odom.heading_rad", heading_rad);
  wmcp_text(w, "mode", mode);
  wmcp_integer(w, "turns", turns);
  for (int i = 0; i < 8; i++) {
    char name[] = "proximity.ps0";
    name[12] = (char)('0' + i);
    wmcp_number(w, name, eyes[i]);
  }
  wmcp_number(w, "wheel_target_radps.left", left_speed());
  wmcp_number(w, "wheel_target_radps.right", right_speed());
  wmcp_publish(w);
}

int main(void) {
  wb_robot_init();
  const int step = (int)wb_robot_get_basic_time_step();
  WbDeviceTag motors[] = {wb_robot_get_device("left wheel motor"),
                          wb_robot_get_device("right wheel motor")};
  WbDeviceTag encoders[] = {wb_robot_get_device("left wheel sensor"),
                            wb_robot_get_device("right wheel sensor")};
  WbDeviceTag sensors[8];
  for (int i = 0; i < 8; i++) {
    char name[] = "ps0";
    name[2] = (char)('0' + i);
    sensors[i] = wb_robot_get_device(name);
    wb_distance_sensor_enable(sensors[i], step);
  }
  for (int i = 0; i < 2; i++) {
    wb_position_sensor_enable(encoders[i], step);
    wb_motor_set_position(motors[i], INFINITY);
  }
  wmcp *w = wmcp_open(NULL, wb_robot_get_name(), wb_robot_get_world_path(),
                      wb_robot_get_basic_time_step(), 0);
  start();
  double last_s = 0.0;
  while (wb_robot_step(step) != -1) {
    const double time_s = wb_robot_get_time();
    if (time_s < last_s) start();
    last_s = time_s;
    for (int i = 0; i < 8; i++) eyes[i] = wb_distance_sensor_get_value(sensors[i]);
    reckon(wb_position_sensor_get_value(encoders[0]), wb_position_sensor_get_value(encoders[1]));
    publish(w, time_s);
    decide();
    wb_motor_set_velocity(motors[0], left_speed());
    wb_motor_set_velocity(motors[1], right_speed());
  }
  wmcp_close(w);
  wb_robot_cleanup();
  return 0;
}
