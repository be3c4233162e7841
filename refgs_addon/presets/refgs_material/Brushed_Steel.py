base_color = (0.56, 0.57, 0.58, 1.0)
color_amount = 1.0
metallic = 1.0
metallic_amount = 1.0
roughness = 0.4
roughness_amount = 1.0
