#define PARAM_FLOAT 'f'
#define PARAM_UINT8 'b'
#define PARAM_GROUP_START(name) void *const param_##name[] = {
#define PARAM_ADD(type, name, address) (void *)(address),
#define PARAM_GROUP_STOP(name) 0};
