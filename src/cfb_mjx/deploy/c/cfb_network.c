/* See cfb_network.h. */
#include "cfb_network.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

/* exp(x) for |x| < 80, to float precision: x = k ln 2 + r with |r| <= ln 2 / 2, ln 2 in two parts so that k ln 2 loses
 * nothing, and the series of exp(r) up to r^7. */
static float exponential(float x) {
  const float turns = x * 1.44269504f;
  const int k = (int)(turns < 0.0f ? turns - 0.5f : turns + 0.5f);
  const float r = (x - (float)k * 0.693359375f) + (float)k * 2.12194440e-4f;
  float series = 1.0f / 5040.0f;
  series = series * r + 1.0f / 720.0f;
  series = series * r + 1.0f / 120.0f;
  series = series * r + 1.0f / 24.0f;
  series = series * r + 1.0f / 6.0f;
  series = series * r + 0.5f;
  series = series * r + 1.0f;
  series = series * r + 1.0f;
  const uint32_t bits = (uint32_t)(k + 127) << 23;
  float power;
  memcpy(&power, &bits, sizeof power);
  return series * power;
}

static float hyperbolic_tangent(float x) {
  const float size = x < 0.0f ? -x : x;
  /* Beyond 9.1, tanh is 1 in single precision. Written so that what is no number ends here too. */
  const float value = size < 9.1f ? 1.0f - 2.0f / (exponential(2.0f * size) + 1.0f) : 1.0f;
  return x < 0.0f ? -value : value;
}

static float swish(float x) {
  if (x < -80.0f) return 0.0f;
  return x > 80.0f ? x : x / (1.0f + exponential(-x));
}

//@gru
/* Written so that what is no number is a shut gate. */
static float sigmoid(float x) {
  if (!(x > -80.0f)) return 0.0f;
  return x > 80.0f ? 1.0f : 1.0f / (1.0f + exponential(-x));
}

//@end
static float activated(cfb_activation_t activation, float x) {
  switch (activation) {
    case CFB_RELU:
      return x > 0.0f ? x : 0.0f;
    case CFB_SWISH:
      return swish(x);
    default:
      return hyperbolic_tangent(x);
  }
}

static float limited(float x, float limit) { return x > limit ? limit : (x < -limit ? -limit : x); }

static int frame_length(const cfb_network_t *network) { return network->position ? 18 : 15; }

static float length_of(const float *vector) {
  return sqrtf(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2] + 1e-12f);
}

/* b asinh(length / b): short lengths as they are, long ones on a logarithmic scale; b = 0: all as they are. */
static float bent(float length, float b) {
  if (b <= 0.0f) return length;
  const float ratio = length / b;
  return b * logf(ratio + sqrtf(ratio * ratio + 1.0f));
}

/* ``vector`` of the world as the body sees it, or as it is. */
static void in_axes(const float *vector, const float *turn, int body, float *seen) {
  for (int i = 0; i < 3; i++)
    seen[i] = body ? turn[i] * vector[0] + turn[3 + i] * vector[1] + turn[6 + i] * vector[2] : vector[i];
}

static void rotation(const float *quaternion, float *turn) {
  const float w = quaternion[0], x = quaternion[1], y = quaternion[2], z = quaternion[3];
  turn[0] = 1.0f - 2.0f * (y * y + z * z);
  turn[1] = 2.0f * (x * y - w * z);
  turn[2] = 2.0f * (x * z + w * y);
  turn[3] = 2.0f * (x * y + w * z);
  turn[4] = 1.0f - 2.0f * (x * x + z * z);
  turn[5] = 2.0f * (y * z - w * x);
  turn[6] = 2.0f * (x * z - w * y);
  turn[7] = 2.0f * (y * z + w * x);
  turn[8] = 1.0f - 2.0f * (x * x + y * y);
}

static void write_frame(const cfb_network_t *network, const cfb_estimate_t *estimate, float *frame) {
  float p[3], v[3], turn[9];
  rotation(estimate->quaternion, turn);
  in_axes(estimate->position, turn, network->body_position, p);
  in_axes(estimate->velocity, turn, network->body_velocity, v);
  if (network->position) {
    const float distance = length_of(p);
    const float shrink = bent(fminf(distance, network->position_limit), network->position_bend) / distance;
    for (int i = 0; i < 3; i++) *frame++ = p[i] * shrink / network->position_scale;
  }
  const float speed = length_of(v), shrink = bent(speed, network->velocity_bend) / speed;
  for (int i = 0; i < 3; i++) *frame++ = v[i] * shrink / network->velocity_scale;
  for (int i = 0; i < 9; i++) *frame++ = turn[i];
  for (int i = 0; i < 3; i++) *frame++ = estimate->body_rate[i] / network->rate_scale;
}

void cfb_network_start(const cfb_network_t *network, cfb_memory_t *memory, const cfb_estimate_t *estimate,
                       const float command[4]) {
  memset(memory, 0, sizeof *memory);
  for (int i = 0; i < network->past_estimates * network->estimate_stride; i++)
    write_frame(network, estimate, memory->frames[i]);
  for (int i = 0; i < network->past_commands; i++)
    for (int motor = 0; motor < 4; motor++) memory->commands[i][motor] = 2.0f * command[motor] - 1.0f;
}

/* Newest frame, past frames, past commands, integral, previews, set-points. */
static void observe(const cfb_network_t *network, const cfb_memory_t *memory, const cfb_estimate_t *estimate,
                    const float *setpoint, float *shown) {
  const int length = frame_length(network);
  float turn[9], ahead[3];
  if (network->previews) rotation(estimate->quaternion, turn);
  write_frame(network, estimate, shown);
  shown += length;
  for (int i = 1; i <= network->past_estimates; i++, shown += length)
    memcpy(shown, memory->frames[i * network->estimate_stride - 1], (size_t)length * sizeof *shown);
  for (int i = 0; i < network->past_commands; i++, shown += 4)
    memcpy(shown, memory->commands[i], 4 * sizeof *shown);
  if (network->integral)
    for (int i = 0; i < 3; i++) *shown++ = memory->integral[i] / network->integral_limit;
  for (int i = 0; i < network->previews; i++, setpoint += 3) {
    in_axes(setpoint, turn, network->body_position, ahead);
    for (int axis = 0; axis < 3; axis++) *shown++ = ahead[axis] / network->preview_scale;
  }
  for (int i = 0; i < network->setpoints; i++) *shown++ = setpoint[i] / network->setpoint_scales[i];
}

/* Four sums side by side: a single one would wait for the floating-point unit at every term. */
static float product(const float *a, const float *b, int length) {
  float sum0 = 0.0f, sum1 = 0.0f, sum2 = 0.0f, sum3 = 0.0f;
  int i = 0;
  for (; i + 3 < length; i += 4) {
    sum0 += a[i] * b[i];
    sum1 += a[i + 1] * b[i + 1];
    sum2 += a[i + 2] * b[i + 2];
    sum3 += a[i + 3] * b[i + 3];
  }
  for (; i < length; i++) sum0 += a[i] * b[i];
  return (sum0 + sum1) + (sum2 + sum3);
}

//@gru
/* The reset gate is inside the candidate. The new state is written to ``next``: all gates see the old one. */
static void unit(const cfb_gru_t *gru, const float *seen, const float *hidden, float *next) {
  for (int j = 0; j < gru->size; j++) {
    float given[3], kept[3];
    for (int gate = 0; gate < 3; gate++) {
      const int row = gate * gru->size + j;
      given[gate] = gru->input_biases[row] + product(gru->input_weights + row * gru->inputs, seen, gru->inputs);
      kept[gate] = gru->hidden_biases[row] + product(gru->hidden_weights + row * gru->size, hidden, gru->size);
    }
    const float reset = sigmoid(given[0] + kept[0]), update = sigmoid(given[1] + kept[1]);
    next[j] = (1.0f - update) * hyperbolic_tangent(given[2] + reset * kept[2]) + update * hidden[j];
  }
}

void cfb_network_command(const cfb_network_t *network, cfb_memory_t *memory, const cfb_estimate_t *estimate,
//@end
//@no gru
void cfb_network_command(const cfb_network_t *network, const cfb_memory_t *memory, const cfb_estimate_t *estimate,
//@end
                         const float *setpoint, float command[4]) {
  /* Not on the stack: the firmware's task has little of it. */
  static float one[CFB_WIDEST], other[CFB_WIDEST];
  float *from = one, *to = other;
  observe(network, memory, estimate, setpoint, from);
  for (int i = 0; i < network->layers; i++) {
//@gru
    if (i == network->before) {
      unit(&network->gru, from, memory->hidden, to);
      memcpy(memory->hidden, to, (size_t)network->gru.size * sizeof *to);
      float *const seen = from;
      from = to;
      to = seen;
    }
//@end
    const cfb_layer_t *const layer = &network->layer[i];
    const int last = i + 1 == network->layers;
    for (int j = 0; j < layer->outputs; j++) {
      const float sum = layer->biases[j] + product(layer->weights + j * layer->inputs, from, layer->inputs);
      to[j] = last ? sum : activated(network->activation, sum);
    }
    float *const swap = from;
    from = to;
    to = swap;
  }
  for (int motor = 0; motor < 4; motor++) {
    const float x = network->limit == CFB_LIMIT_CLIP ? limited(from[motor], 1.0f) : hyperbolic_tangent(from[motor]);
    const float u = 0.5f * (1.0f + x);
    command[motor] = u > 1.0f ? 1.0f : (u > 0.0f ? u : 0.0f);
  }
}

void cfb_network_remember(const cfb_network_t *network, cfb_memory_t *memory, const cfb_estimate_t *estimate,
                          const float command[4]) {
  const int frames = network->past_estimates * network->estimate_stride;
  if (frames > 0) {
    memmove(memory->frames[1], memory->frames[0], (size_t)(frames - 1) * sizeof memory->frames[0]);
    write_frame(network, estimate, memory->frames[0]);
  }
  if (network->past_commands > 0) {
    memmove(memory->commands[1], memory->commands[0],
            (size_t)(network->past_commands - 1) * sizeof memory->commands[0]);
    for (int motor = 0; motor < 4; motor++) memory->commands[0][motor] = 2.0f * command[motor] - 1.0f;
  }
  for (int i = 0; i < 3; i++) {
    const float grown =
        memory->integral[i] + network->dt * limited(estimate->position[i], network->integral_input_limit);
    memory->integral[i] = limited(grown, network->integral_limit);
  }
}
