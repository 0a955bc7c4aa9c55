/* A small network, and what it is shown: the observation with its history.
 *
 * Part of a policy exported by cfb_mjx. C11, single precision, no heap; nothing here changes but the memory it is
 * given, and numbers between two layers: one caller at a time. The meaning of every number is in contract.json.
 */
#ifndef CFB_NETWORK_H
#define CFB_NETWORK_H

#include "cfb_sizes.h"

typedef enum { CFB_TANH, CFB_RELU, CFB_SWISH } cfb_activation_t;
/* How the last layer is brought to -1..1. */
typedef enum { CFB_LIMIT_TANH, CFB_LIMIT_CLIP } cfb_limit_t;

typedef struct {
  int inputs, outputs;
  const float *weights; /* outputs rows of inputs */
  const float *biases;
} cfb_layer_t;

//@gru
/* A gated recurrent unit: rows of reset, then update, then candidate. */
typedef struct {
  int inputs, size;
  const float *input_weights;  /* 3 size rows of inputs */
  const float *input_biases;
  const float *hidden_weights; /* 3 size rows of size */
  const float *hidden_biases;
} cfb_gru_t;

//@end
typedef struct {
  /* What is shown. */
  int position, body_position, body_velocity, integral; /* yes or no */
  int past_estimates, estimate_stride, past_commands, previews, setpoints;
  float position_limit, position_bend, position_scale, velocity_bend, velocity_scale, rate_scale;
  float integral_input_limit, integral_limit, preview_scale, dt;
  const float *setpoint_scales;
  /* What is made of it. */
  cfb_activation_t activation;
  cfb_limit_t limit;
  int layers;
  const cfb_layer_t *layer;
//@gru
  int before; /* number of layers before the recurrent unit */
  cfb_gru_t gru;
//@end
} cfb_network_t;

/* What the state estimator says, position relative to the target. */
typedef struct {
  float position[3], velocity[3]; /* world; m, m/s */
  float quaternion[4];            /* w, x, y, z; body to world; unit norm */
  float body_rate[3];             /* body; rad/s */
} cfb_estimate_t;

typedef struct {
  float frames[CFB_KEPT_FRAMES][CFB_FRAME];  /* of every step, shown or not, newest first */
  float commands[CFB_KEPT_COMMANDS][4];      /* as they are shown, 2 u - 1, newest first */
  float integral[3];                         /* of the relative position, m s */
//@gru
  float hidden[CFB_HIDDEN];                  /* state of the recurrent unit */
//@end
} cfb_memory_t;

//@no gru
/* As if this had been estimated, and these outputs been commanded, for long. */
//@end
//@gru
/* As if this had been estimated, and these outputs been commanded, for long; the recurrent unit's state is zero. */
//@end
void cfb_network_start(const cfb_network_t *network, cfb_memory_t *memory, const cfb_estimate_t *estimate,
                       const float command[4]);

/* The four outputs, each in [0, 1]. setpoint: displacements of the target, three numbers for each preview, and then
 * the set-points; it may be NULL where the network has neither. */
//@no gru
void cfb_network_command(const cfb_network_t *network, const cfb_memory_t *memory, const cfb_estimate_t *estimate,
//@end
//@gru
/* The recurrent unit's state moves on: once every step. */
void cfb_network_command(const cfb_network_t *network, cfb_memory_t *memory, const cfb_estimate_t *estimate,
//@end
                         const float *setpoint, float command[4]);

/* Once every step, with the command that was given. */
void cfb_network_remember(const cfb_network_t *network, cfb_memory_t *memory, const cfb_estimate_t *estimate,
                          const float command[4]);

#endif
