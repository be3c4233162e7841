base_color = (0.972, 0.96, 0.915, 1.0)
color_amount = 1.0
metallic = 1.0
metallic_amount = 1.0
roughness = 0.1
roughness_amount = 1.0
