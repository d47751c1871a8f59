// One model function at given arguments. Verification compares it with its float64 reference. Lanes are cells.
// out: [COMPONENTS][cells]; the cells are the function's own arguments, then the models' numbers.
__kernel void evaluate(__global scalar *restrict out, const int cells CELL_ARRAYS) {
  const int g = get_global_id(0);
  if ((g + 1) * W > cells) return;
  CELL_LOAD
  EVALUATE
}
