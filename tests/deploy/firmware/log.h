/* Groups become tables of what they name, so that names and types are compiled. */
#define LOG_FLOAT 'f'
#define LOG_UINT8 'b'
#define LOG_UINT32 'i'
#define LOG_GROUP_START(name) const void *const log_##name[] = {
#define LOG_ADD(type, name, address) (void *)(address),
#define LOG_GROUP_STOP(name) 0};
