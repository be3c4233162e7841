color_amount = 0.0
metallic = 1.0
metallic_amount = 1.0
roughness = 0.05
roughness_amount = 1.0
