const int first_pixel = pixels.first_ray, instant = pixels.instant, top = pixels.top, left = pixels.left;
const int rows = pixels.rows, columns = pixels.columns;
